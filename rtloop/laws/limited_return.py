"""The return of a loop from a limit of its command, beside the return of the same loop without a limit.

    x_{k+1} = x_k + LAG (g v_applied − x_k)        plant: a lag of the gain g of the law's model, or 1

Both loops come back from the position that the limit can just hold. One rested there; the other was asked for BEYOND
times as much meanwhile. A law that does not wind up comes back from both alike.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Real = npt.NDArray[np.float64]
LAG = 0.2
BACK_SHARE = 0.05
"""Part of the way that is left when the loop counts as back."""
BEYOND = 3.0
MOST_TICKS = 5000
"""A loop without a limit that is not back after so many ticks is not judged."""
FURTHEST = 0.5
"""Overshoot of a loop without a limit, as a part of the way, from which on it is not judged."""
SATURATED = 2
"""The limit is in force for so many times the ticks of the unlimited return."""
Tick = Callable[[Real, Real, float], Real]
"""From position, reference (axes,) and limit of the command to the commands applied (axes,), all in µm."""


class Return(NamedTuple):
    """Ticks until BACK of the way is left, on every axis, and the largest overshoot as a part of the way."""

    ticks: int
    overshoot: float


class LimitedLoop:
    """A law's `tick` around the plant; `limit_um` is that of its command."""

    def __init__(self, tick: Tick, gains: Real, limit_um: float) -> None:
        self._tick, self._gains, self.limit_um = tick, gains, limit_um
        self.position_um = self.edge_um

    @property
    def edge_um(self) -> Real:
        """Positions (axes,) that the limit can just hold."""
        return self._gains * self.limit_um

    def follow(self, reference_um: Real, ticks: int, limited: bool) -> Real:
        """Positions (ticks, axes) behind each tick."""
        positions = np.empty((ticks, self._gains.size))
        limit_um = self.limit_um if limited else np.inf
        for k in range(ticks):
            applied_um = self._tick(self.position_um, reference_um, limit_um)
            self.position_um = positions[k] = self.position_um + LAG * (self._gains * applied_um - self.position_um)
        return positions

    def unlimited_return(self) -> Return | None:
        """From rest at the edge to 0; None where it is not back after MOST_TICKS, or overshoots by FURTHEST."""
        shares, zero_um = np.ones((1, self._gains.size)), np.zeros_like(self._gains)
        while (ticks := _ticks_until_back(shares)) is None:
            if shares.shape[0] > MOST_TICKS or not np.abs(shares).max() < BEYOND:
                return None
            shares = np.concatenate([shares, self.follow(zero_um, 100, limited=False) / self.edge_um])
        further_shares = self.follow(zero_um, ticks, limited=False) / self.edge_um
        result = Return(ticks, _overshoot(np.concatenate([shares, further_shares])))
        return result if result.overshoot < FURTHEST else None

    def limited_return(self, saturated_ticks: int, most_ticks: int) -> Return | None:
        """From the limit to 0; None where it is not back after `most_ticks`."""
        self.follow(BEYOND * self.edge_um, saturated_ticks, limited=True)
        start_um = self.position_um
        part = self.follow(np.zeros_like(start_um), 2 * most_ticks, limited=True) / self.edge_um
        ticks = _ticks_until_back(part)
        return None if ticks is None or ticks > most_ticks else Return(ticks, _overshoot(part))


def _ticks_until_back(part: Real) -> int | None:
    """Ticks until every axis has been once within BACK of 0, or beyond it; None where one has not."""
    reached = np.any(part <= BACK_SHARE, axis=0)
    return int(np.argmax(part <= BACK_SHARE, axis=0).max()) + 1 if reached.all() else None


def _overshoot(part: Real) -> float:
    return max(0.0, -float(part.min()))


def dc_gains(model: Any, axes: int) -> Real:
    """Gain at 0 Hz of each axis's model (axes,); 1 where there is none."""
    models = model if isinstance(model, tuple) else (model,) * axes
    return np.array([1.0 if axis_model is None else axis_model.transfer().dc_gain for axis_model in models])
