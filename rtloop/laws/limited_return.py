"""Test of a law for windup: the return of its loop from a limit of the command, against the return without a limit.

    x_{k+1} = x_k + LAG (g v_applied − x_k)        plant: a lag with the gain g of the law's model, or 1

Both loops return from the position at the edge of the limited range. One rested there; the other had an error of
BEYOND times that position, minus the position. A law without windup returns equally from both. The error comes from the
reference or from a load, an offset of the measured position, so that a law's own use of one of them is no windup."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rtloop.foundation.arrays import Real

LAG = 0.2
BACK_SHARE = 0.05
"""Fraction of the way that may remain when the loop counts as returned."""
BEYOND = 3.0
MOST_TICKS = 5000
"""An unlimited loop that has not returned after this many ticks is not judged."""
FURTHEST = 0.5
"""An unlimited loop is not judged from this overshoot on, as a fraction of the way."""
SATURATED = 2
"""Duration of the limit, in multiples of the ticks of the unlimited return."""
Tick = Callable[[Real, Real, float], Real]
"""Function from position, reference (axes,) and limit of the command to the applied commands (axes,), all in µm."""


class Return(NamedTuple):
    """Return of a loop from the edge of its limited range.

    Ticks until every axis had at most BACK_SHARE of the way left, and the largest overshoot as a fraction of the way.
    """

    ticks: int
    overshoot: float


class LimitedLoop:
    """Loop of a law's `tick` and the plant; `limit_um` is the limit of the command.

    With `by_load` a load takes the place of the reference: the law's reference is 0, its position x − reference.
    """

    def __init__(self, tick: Tick, gains: Real, limit_um: float, by_load: bool) -> None:
        """Put the plant, with `gains` (axes,), at the edge of its limited range; the caller sets the law's state."""
        self._tick, self._gains, self.limit_um, self._by_load = tick, gains, limit_um, by_load
        self.position_um = self.edge_um

    @property
    def edge_um(self) -> Real:
        """Positions (axes,) in µm that a command of `limit_um` holds: gain times limit, with the sign of the gain."""
        return self._gains * self.limit_um

    def follow(self, reference_um: Real, ticks: int, limited: bool) -> Real:
        """Run `ticks` ticks with a constant reference; return the positions (ticks, axes) in µm after each.

        The loop continues from its last position; without `limited`, the command has no limit.
        """
        positions = np.empty((ticks, self._gains.size))
        limit_um = self.limit_um if limited else np.inf
        load_um = reference_um if self._by_load else np.zeros_like(reference_um)
        for k in range(ticks):
            applied_um = self._tick(self.position_um - load_um, reference_um - load_um, limit_um)
            self.position_um = positions[k] = self.position_um + LAG * (self._gains * applied_um - self.position_um)
        return positions

    def unlimited_return(self) -> Return | None:
        """Run the loop from rest at the edge to 0 without a limit; return the ticks and overshoot of this way.

        None if it takes more than about MOST_TICKS, diverges, or overshoots by FURTHEST of the way or more.
        """
        shares, zero_um = np.ones((1, self._gains.size)), np.zeros_like(self._gains)
        while (ticks := _ticks_until_back(shares)) is None:
            if shares.shape[0] > MOST_TICKS or not np.abs(shares).max() < BEYOND:
                return None
            shares = np.concatenate([shares, self.follow(zero_um, 100, limited=False) / self.edge_um])
        further_shares = self.follow(zero_um, ticks, limited=False) / self.edge_um
        result = Return(ticks, _overshoot(np.concatenate([shares, further_shares])))
        return result if result.overshoot < FURTHEST else None

    def limited_return(self, saturated_ticks: int, most_ticks: int) -> Return | None:
        """Saturate the loop for `saturated_ticks`, then let it return to 0; return the ticks and overshoot of this way.

        The reference is BEYOND times the edge, then 0; the command is limited all the time.
        None if the return takes more than `most_ticks`.
        """
        self.follow(BEYOND * self.edge_um, saturated_ticks, limited=True)
        start_um = self.position_um
        part = self.follow(np.zeros_like(start_um), 2 * most_ticks, limited=True) / self.edge_um
        ticks = _ticks_until_back(part)
        return None if ticks is None or ticks > most_ticks else Return(ticks, _overshoot(part))


def _ticks_until_back(part: Real) -> int | None:
    """Return the ticks until every axis was at or below BACK_SHARE once; None if one was not.

    `part` (ticks, axes) has the fraction of the way to 0 that remains after each tick.
    """
    reached = np.any(part <= BACK_SHARE, axis=0)
    return int(np.argmax(part <= BACK_SHARE, axis=0).max()) + 1 if reached.all() else None


def _overshoot(part: Real) -> float:
    """Return the largest overshoot beyond 0, as a fraction of the way; `part` (ticks, axes): fractions that remain."""
    return max(0.0, -float(part.min()))


def dc_gains(model: Any, axes: int) -> Real:
    """Return the gain at 0 Hz (axes,), µm of position per µm of command; +inf with an integrator, 1 without a model.

    `model` is the model of a law: one for every axis, a tuple with one for each axis, or None; an entry may be None.
    """
    models = model if isinstance(model, tuple) else (model,) * axes
    return np.array([1.0 if axis_model is None else axis_model.transfer().dc_gain for axis_model in models])
