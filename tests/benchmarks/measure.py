"""Timing of several programs that do the same work; they run in turn, so that other load affects all alike."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple


class Effort(NamedTuple):
    """Number of repetitions of a benchmark, and the share of the usual duration that each repetition takes."""

    pairs: int
    share: float

    def duration_s(self, usual_s: float) -> float:
        """Return the shortened duration of a repetition."""
        return usual_s * self.share


FULL, QUICK = Effort(11, 1.0), Effort(3, 0.25)


class MeasurementUnavailable(Exception):
    """A requirement of a benchmark is missing; the message names it."""


class Spread(NamedTuple):
    """Median, smallest and largest of several runs."""

    median: float
    minimum: float
    maximum: float

    @classmethod
    def from_values(cls, values: Sequence[float]) -> Spread:
        """Return the spread of several values."""
        return cls(statistics.median(values), min(values), max(values))

    def scaled(self, factor: float) -> Spread:
        """Return the spread multiplied by a factor."""
        return Spread(*(value * factor for value in self))


class Pair(NamedTuple):
    """Durations (s) of two programs, and the ratios of the first to the second, pair by pair."""

    first: Spread
    second: Spread
    ratio: Spread


def show_progress(text: str) -> None:
    """Show a line of progress, if standard error is a terminal."""
    if sys.stderr.isatty():
        print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)


def time_call(action: Callable[[], object]) -> float:
    """Return the wall time of one call in s."""
    begin = time.perf_counter()
    action()
    return time.perf_counter() - begin


def interleave(actions: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, list[Any]]:
    """Call each action once a round; return the results of each action by its name."""
    results: dict[str, list[Any]] = {name: [] for name in actions}
    for number in range(rounds):
        show_progress(f"round {number + 1} of {rounds}")
        for name, action in actions.items():
            results[name].append(action())
    return results


def ratio(numerators: Sequence[float], denominators: Sequence[float]) -> dict[str, float]:
    """Return the spread of the quotients, pair by pair."""
    return spread([a / b for a, b in zip(numerators, denominators, strict=True)])


def spread(values: Sequence[float]) -> dict[str, float]:
    """Return a Spread as the dict that a benchmark reports."""
    return Spread.from_values(values)._asdict()


def time_alternately(first: Callable[[], object], second: Callable[[], object], pairs: int) -> Pair:
    """Time two programs one after the other, `pairs` times, after a pair that is not counted."""
    durations_s = [(time_call(first), time_call(second)) for _ in range(pairs + 1)][1:]
    firsts_s, seconds_s = zip(*durations_s, strict=True)
    ratios = [first_s / second_s for first_s, second_s in durations_s]
    return Pair(Spread.from_values(firsts_s), Spread.from_values(seconds_s), Spread.from_values(ratios))
