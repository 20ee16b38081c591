"""Actuator of a simulated stage: a sum of play operators with a hysteresis of a given width, in closed form.

Between two drives that are S apart, a play of threshold r moves by S − 2r, and its loop is min(2r, S − 2r) high in the
middle of the drive. The width of the actuator's major loop, as a share of the stroke, is therefore

    h/H = Σ w min(2r, S − 2r) / Σ w (S − 2r).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

THRESHOLDS = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8)
"""Thresholds of the play operators, as fractions of half the drive's range."""
WEIGHTS = (1.3, 0.3, 0.2, 0.3, 0.2, 0.2)
"""Weights relative to one another where no hysteresis is given: the loop is as wide as a piezo stack's."""


@dataclass(frozen=True)
class Actuator:
    """Play operators with thresholds in V and weights in µm/V, driven from `lowest_v` ≤ 0 to `highest_v` > 0."""

    lowest_v: float
    highest_v: float
    thresholds_v: tuple[float, ...]
    weights_um_per_v: tuple[float, ...]

    def rise_um(self, drive_v: float) -> float:
        """Return the position, µm, at a drive of `drive_v` ≥ 0 that is reached from rest."""
        return _travel_um(self.weights_um_per_v, self.thresholds_v, drive_v)

    def fall_um(self, change_v: float) -> float:
        """Return the distance, µm, by which the position falls while the drive falls from `highest_v` by `change_v`.

        `change_v` is at most twice `highest_v`: no play with a threshold above `highest_v` moves.
        """
        return _travel_um(self.weights_um_per_v, self._turns_v, change_v)

    @property
    def _turns_v(self) -> list[float]:
        """Fall of the drive, V, from `highest_v` after which each play operator begins to fall."""
        return [2 * threshold for threshold in self.thresholds_v]

    @property
    def lowest_um(self) -> float:
        """Position in µm at `lowest_v`, reached from `highest_v`: the lower end of the major loop."""
        return self.rise_um(self.highest_v) - self.fall_um(self.highest_v - self.lowest_v)

    @property
    def hysteresis_percent(self) -> float:
        """Width of the major loop in percent of its stroke."""
        span_v = self.highest_v - self.lowest_v
        plays = zip(self.weights_um_per_v, self.thresholds_v, strict=True)
        width_um = sum(weight * min(2 * threshold, span_v - 2 * threshold) for weight, threshold in plays)
        return 100 * width_um / self.fall_um(span_v)

    def drives_within(self, limit_um: float) -> tuple[float, float]:
        """Return the lowest (≤ 0) and the highest (≥ 0) drive in V between which a slow motion from rest stays within
        ±`limit_um`.

        Both lie within the actuator's range of drives. The motion begins upwards, and is
        assumed to reach the highest drive before the lowest.
        """
        highest_v = _largest(self.rise_um, self.thresholds_v, limit_um, self.highest_v)
        part = Actuator(self.lowest_v, highest_v, self.thresholds_v, self.weights_um_per_v)
        fall_v = _largest(part.fall_um, part._turns_v, part.rise_um(highest_v) + limit_um, highest_v - self.lowest_v)
        return min(highest_v - fall_v, 0.0), highest_v


def make_actuator(lowest_v: float, highest_v: float, range_um: float, hysteresis_percent: float | None) -> Actuator:
    """Return an actuator whose position is `range_um` at `highest_v`, reached from rest.

    `hysteresis_percent` is the width of the major loop in percent of its stroke, 0 to 30; None: as WEIGHTS give it.
    """
    half_v = (highest_v - lowest_v) / 2
    thresholds_v = tuple(half_v * threshold for threshold in THRESHOLDS)
    shares = WEIGHTS if hysteresis_percent is None else _weights(hysteresis_percent / 100)
    scale = range_um / _travel_um(shares, thresholds_v, highest_v)
    return Actuator(lowest_v, highest_v, thresholds_v, tuple(scale * share for share in shares))


def _weights(width: float) -> tuple[float, ...]:
    """Return weights relative to one another: 1, then WEIGHTS[1:] times one factor.

    With them the major loop, over a symmetric drive, is `width` wide, as a fraction of the stroke.
    """
    plays = list(zip(WEIGHTS[1:], THRESHOLDS[1:], strict=True))
    height = sum(weight * min(2 * threshold, 2 - 2 * threshold) for weight, threshold in plays)
    stroke = sum(weight * (2 - 2 * threshold) for weight, threshold in plays)
    factor = 2 * width / (height - width * stroke)  # of width = factor · height / (2 + factor · stroke)
    return (1.0, *(factor * weight for weight in WEIGHTS[1:]))


def _travel_um(weights: Sequence[float], dead_v: Sequence[float], change_v: float) -> float:
    """Return the sum of the weights times the part of `change_v` beyond each play's dead range, `dead_v`."""
    return sum(weight * max(0.0, change_v - dead) for weight, dead in zip(weights, dead_v, strict=True))


def _largest(curve: Callable[[float], float], turns_v: Sequence[float], limit_um: float, most_v: float) -> float:
    """Return the largest change of the drive, 0 to `most_v`, with which the rising `curve` is at most `limit_um`.

    The curve is straight between `turns_v`, which contain 0.
    """
    points_v = sorted({turn for turn in turns_v if turn <= most_v} | {most_v})
    return float(np.interp(limit_um, [curve(point) for point in points_v], points_v))
