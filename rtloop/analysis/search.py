"""Searches in one variable: the first value at which a condition fails, and a zero of a function."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rtloop.foundation.arrays import Real

GROWTH = 1.1
"""Growth of the steps: limits far from the model need no precision of a quarter percent, and small steps would take
minutes."""


def find_limit(holds: Callable[[float], bool], largest: float, step: float, tolerance: float) -> float:
    """Return the largest value up to `largest` such that `holds` is true from 0 to it, or at most `tolerance` less.

    `holds` is taken to be true at 0. The search steps outwards, first by `step`, each further step a tenth longer, then
    bisects; a failure narrower than a step may be missed. `largest` is returned only if no step failed.
    """
    low = 0.0
    while holds(min(low + step, largest)):
        low += step
        if low >= largest:
            return largest
        step *= GROWTH
    high = min(low + step, largest)
    while high - low > tolerance:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def zero_between(function: Callable[[Real], Real], low: float, high: float) -> float:
    """Return a zero of the vectorised `function` between two points where its signs differ: cut into 32 intervals, ten
    times.
    """
    for _ in range(10):
        points = np.linspace(low, high, 33)
        negative = function(points) < 0
        i = int(np.argmax(negative[1:] != negative[0]))
        low, high = float(points[i]), float(points[i + 1])
    return 0.5 * (low + high)
