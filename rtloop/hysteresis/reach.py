"""Positions that an actuator with hysteresis reaches while its drive keeps unequal limits u⁻ ≤ 0 ≤ u⁺.

After a peak u⁺ on the initial loading curve φ, the falling branch is lower by twice the curve at half the way back:

    x(u) = φ(u⁺) − 2 φ((u⁺ − u)/2),     0 ≤ u⁺ − u ≤ 2 u⁺

so that the memory takes a part of the shorter side: x(u⁻) ≥ −φ(−u⁻), and equal only for u⁻ = −u⁺. For u⁻ = 0 it leaves
the remanence x(0) > 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import loading_curve, model_output

TOLERANCE = 1e-9
"""Excess of a drive over its limits, as a fraction of both together, that is rounding."""


class PositionRange(NamedTuple):
    """Lowest and highest position in µm, in this order."""

    low_um: float
    high_um: float

    @property
    def span_um(self) -> float:
        """Distance between both ends in µm."""
        return self.high_um - self.low_um

    def __str__(self) -> str:
        """Return both ends with four digits: "-4.8 … 38 µm"."""
        return f"{self.low_um:.4g} … {self.high_um:.4g} µm"


def reachable_range(model: PlayModel, lowest_v: float, highest_v: float, largest_um: float = np.inf) -> PositionRange:
    """Return the range of positions that `model`, from rest, can take in any order, with a drive of `lowest_v` ≤ 0 to
    `highest_v` ≥ 0.

    They lie within ±`largest_um`. With a drive of one sign alone, the remanence is the end next to 0: the actuator is
    at 0 before its first peak, and does not return to 0. Raises ValueError for a model without inverse.
    """
    is_negative = model.weights.sum() < 0
    if is_negative or -lowest_v > highest_v:
        mirrored_model, ends_v = (
            (negate(model), (lowest_v, highest_v)) if is_negative else (model, (-highest_v, -lowest_v))
        )
        mirrored = reachable_range(mirrored_model, *ends_v, largest_um)
        return PositionRange(-mirrored.high_um, -mirrored.low_um)
    high_um = min(float(loading_curve(model, highest_v)), largest_um)
    peak_v = min(highest_v, _outermost_drives(model, [high_um])[1])
    return_um = 2 * float(loading_curve(model, (peak_v - lowest_v) / 2))
    low_um = max(high_um - return_um, -largest_um)
    return PositionRange(low_um if abs(low_um) > TOLERANCE * high_um else 0.0, high_um)


def can_hold(model: PlayModel, positions_um: npt.ArrayLike, lowest_v: float, highest_v: float) -> bool:
    """Whether a virgin `model` can take the positions one after the other with a drive of `lowest_v` to `highest_v`.

    Raises ValueError for a model without inverse.
    """
    positions = np.asarray(positions_um, dtype=float)
    is_negative = model.weights.sum() < 0
    low_v, high_v = _outermost_drives(negate(model), -positions) if is_negative else _outermost_drives(model, positions)
    excess_v = TOLERANCE * (highest_v - lowest_v)
    return lowest_v - excess_v <= low_v and high_v <= highest_v + excess_v


def _outermost_drives(model: PlayModel, positions_um: npt.ArrayLike) -> tuple[float, float]:
    """Return the least (≤ 0) and the largest (≥ 0) drive in V that take a virgin `model` through positions, with 0
    before them.

    A dead band, the first threshold of the model, is added to each that is not 0. Raises ValueError without an inverse.
    """
    dead_band_v = float(model.thresholds[0])
    drive_v: Real = model_output(model.inverse(), positions_um)
    low_v, high_v = float(drive_v.min()), float(drive_v.max())
    return (low_v - dead_band_v if low_v < 0 else 0.0), (high_v + dead_band_v if high_v > 0 else 0.0)


def negate(model: PlayModel) -> PlayModel:
    """Return the model whose output has the opposite sign."""
    return PlayModel(model.thresholds, -model.weights)
