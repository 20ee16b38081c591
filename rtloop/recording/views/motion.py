"""Motion of an axis in closed loop, in one pass: whether its position falls as its drive rises."""

from __future__ import annotations

import math

import numpy as np

from rtloop.foundation.arrays import Real

OPPOSED_CORRELATION = -0.5
"""Pearson's coefficient of drive and position below which they move against each other."""
MOST_TRAVEL = 4.0
"""Path of the drive over its range, up to which it ran away. A loop that oscillates travels its range many times, and
above a resonance its position opposes the drive although the sign is right."""


class Motion:
    """Running sums of drive and position, taken from their first values, so that small changes keep their digits."""

    def __init__(self) -> None:
        """Begin without ticks; `add` takes them in the order of the run."""
        self._count, self._travel_v = 0, 0.0
        self._first, self._last_v = np.zeros((2, 1)), np.zeros(0)
        self._lowest_v, self._highest_v = math.inf, -math.inf
        self._sum, self._products = np.zeros(2), np.zeros((2, 2))

    @np.errstate(over="ignore", invalid="ignore")  # A recording may hold any double.
    def add(self, drive_v: Real, position_um: Real) -> None:
        """Add drive and position (n,) of the next ticks, which follow the ticks of the previous call.

        The step between the calls counts as path of the drive.
        """
        if not drive_v.size:
            return
        motion = np.stack([drive_v, position_um])
        if not self._count:
            self._first = motion[:, :1].copy()
        motion -= self._first
        self._count += drive_v.size
        self._sum += motion.sum(axis=1)
        self._products += motion @ motion.T
        self._travel_v += float(np.abs(np.diff(drive_v, prepend=self._last_v)).sum())
        self._last_v = drive_v[-1:].copy()
        self._lowest_v = min(self._lowest_v, float(drive_v.min()))
        self._highest_v = max(self._highest_v, float(drive_v.max()))

    def ran_away_opposed(self) -> bool:
        """Whether the position moved against the drive, and the drive did not oscillate.

        Their correlation is then below OPPOSED_CORRELATION, and the path of the drive at most MOST_TRAVEL times its
        range. False without ticks, where drive or position is constant, or a number is not finite.
        """
        if not self._count or not np.all(np.isfinite(self._products)):
            return False
        covariance = self._products - np.outer(self._sum, self._sum) / self._count
        product = covariance[0, 0] * covariance[1, 1]
        if product <= 0.0 or self._travel_v > MOST_TRAVEL * (self._highest_v - self._lowest_v):
            return False
        return bool(covariance[0, 1] < OPPOSED_CORRELATION * math.sqrt(product))
