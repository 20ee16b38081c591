"""Ticks that are left out, made small: the least, the largest and the mean value of every column over intervals.

Reductions by numpy, and no other mathematics. NaN does not count.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rtloop.recording.file.topics.overview import LEAST, PARTS, Intervals
from rtloop.signals import TICK

Rows = np.ndarray[Any, Any]


class Decimation:
    """Intervals of `every` ticks that follow each other, or fewer where ticks are missing or `close` ends one."""

    def __init__(self, columns: int, every: int) -> None:
        self._columns, self._every = columns, every
        self._done: list[Rows] = []
        self._count, self._next = 0, 0

    @property
    def pending(self) -> int:
        """Intervals that wait to be written."""
        return len(self._done) + (self._count > 0)

    @property
    def empty(self) -> bool:
        """Whether none does."""
        return self.pending == 0

    @property
    def first(self) -> int:
        """The first tick of those that wait."""
        return int((self._done[0][:, LEAST] if self._done else self._least)[TICK])

    def add(self, rows: Rows) -> None:
        """Rows (n, columns), in order."""
        breaks = np.flatnonzero(np.diff(rows[:, TICK]) != 1) + 1
        for run in np.split(rows, breaks):
            if len(run) and self._count and run[0, TICK] != self._next:
                self._end()
            self._add(run)

    def close(self) -> Intervals:
        """All intervals so far (n, columns, 3); the next one begins anew."""
        self._end()
        intervals, self._done = self._done, []
        return np.stack(intervals) if intervals else np.empty((0, self._columns, len(PARTS)))

    def put_back(self, intervals: Intervals) -> None:
        """Those that could not be written, in front of all others."""
        self._done = [*intervals, *self._done]

    def _add(self, run: Rows) -> None:
        while len(run):
            part, run = run[: self._every - self._count], run[self._every - self._count :]
            is_number = ~np.isnan(part)
            minimum, maximum = np.fmin.reduce(part, axis=0), np.fmax.reduce(part, axis=0)
            with np.errstate(over="ignore", invalid="ignore"):  # any double may stand in a record
                total = np.add.reduce(part, axis=0, where=is_number)
            if self._count == 0:
                self._least, self._most = minimum, maximum
                self._total, self._known = total, np.zeros(self._columns)
            else:
                self._least, self._most = np.fmin(self._least, minimum), np.fmax(self._most, maximum)
                self._total = self._total + total
            self._known += np.count_nonzero(is_number, axis=0)
            self._count, self._next = self._count + len(part), int(part[-1, TICK]) + 1
            if self._count == self._every:
                self._end()

    def _end(self) -> None:
        if self._count == 0:
            return
        with np.errstate(invalid="ignore"):
            mean = np.where(self._known > 0, self._total / np.maximum(self._known, 1), np.nan)
        self._done.append(np.stack([self._least, self._most, mean], axis=1))
        self._count = 0
