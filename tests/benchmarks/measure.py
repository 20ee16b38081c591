"""Times of several that do the same work, in turn, so that a busy machine burdens all alike."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple


class Effort(NamedTuple):
    """How often everything is repeated, and the part of its usual duration that each repetition takes."""

    pairs: int
    share: float

    def seconds(self, usual_s: float) -> float:
        """A duration, shortened."""
        return usual_s * self.share


FULL, QUICK = Effort(11, 1.0), Effort(3, 0.25)


class NotMeasured(Exception):
    """What a benchmark needs is not there; the message says what."""


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


def say(text: str) -> None:
    """What is going on, on a terminal."""
    if sys.stderr.isatty():
        print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)


def seconds(action: Callable[[], object]) -> float:
    """Wall time of one call."""
    begin = time.perf_counter()
    action()
    return time.perf_counter() - begin


def in_turn(actions: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, list[Any]]:
    """What each action returns, round by round, each once a round."""
    results: dict[str, list[Any]] = {name: [] for name in actions}
    for number in range(rounds):
        say(f"round {number + 1} of {rounds}")
        for name, action in actions.items():
            results[name].append(action())
    return results


def ratio(firsts: Sequence[float], others: Sequence[float]) -> dict[str, float]:
    """Spread of the ratios of the first to the others, pair by pair."""
    return spread([one / two for one, two in zip(firsts, others, strict=True)])


def spread(values: Sequence[float]) -> dict[str, float]:
    """A Spread as a benchmark reports it."""
    return Spread.of(values)._asdict()


def alternately(first: Callable[[], object], second: Callable[[], object], pairs: int) -> Pair:
    """Time both, one after the other, `pairs` times; a pair before that warms up."""
    taken = [(seconds(first), seconds(second)) for _ in range(pairs + 1)][1:]
    firsts, seconds_ = [one for one, _ in taken], [two for _, two in taken]
    return Pair(Spread.of(firsts), Spread.of(seconds_), Spread.of([one / two for one, two in taken]))
