"""Times of two that do the same work, in alternating pairs, so that a busy machine burdens both alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple


class Spread(NamedTuple):
    """Median, smallest and largest of several runs."""

    median: float
    minimum: float
    maximum: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        return cls(statistics.median(values), min(values), max(values))

    def scaled(self, factor: float) -> Spread:
        """All of it in another unit."""
        return Spread(*(value * factor for value in self))


class Pair(NamedTuple):
    """Seconds of the first, of the second, and the ratio of the first to the second, pair by pair."""

    first: Spread
    second: Spread
    ratio: Spread


def seconds(action: Callable[[], object]) -> float:
    """Wall time of one call."""
    begin = time.perf_counter()
    action()
    return time.perf_counter() - begin


def alternately(first: Callable[[], object], second: Callable[[], object], pairs: int = 15) -> Pair:
    """Time both, one after the other, `pairs` times; a pair before that warms up."""
    taken = [(seconds(first), seconds(second)) for _ in range(pairs + 1)][1:]
    firsts, seconds_ = [one for one, _ in taken], [two for _, two in taken]
    return Pair(Spread.of(firsts), Spread.of(seconds_), Spread.of([one / two for one, two in taken]))
