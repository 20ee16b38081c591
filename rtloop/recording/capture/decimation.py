"""Reduce omitted ticks to the least, largest and mean value of every column over intervals; NaN is ignored."""

from __future__ import annotations

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.recording.file.topics.overview import MINIMUM, STATISTICS, Intervals
from rtloop.signals import TICK


class Decimation:
    """Statistics of `columns` signals over intervals of `every` consecutive ticks.

    A missing tick or `take_intervals` ends an interval earlier.
    """

    def __init__(self, columns: int, every: int) -> None:
        """Prepare for rows of `columns` signals; an interval has at most `every` ticks."""
        self._columns, self._every = columns, every
        self._intervals: list[Real] = []
        self._interval_ticks, self._next_tick = 0, 0

    @property
    def pending_count(self) -> int:
        """Number of intervals not yet taken, including the unfinished one if it has any ticks."""
        return len(self._intervals) + (self._interval_ticks > 0)

    @property
    def first_tick(self) -> int:
        """First tick of the intervals not yet taken; only defined if there is one."""
        return int((self._intervals[0][:, MINIMUM] if self._intervals else self._minimum)[TICK])

    def add_rows(self, rows: Real) -> None:
        """Add rows (n, columns), ordered by tick; a missing tick ends the present interval."""
        breaks = np.flatnonzero(np.diff(rows[:, TICK]) != 1) + 1
        for run in np.split(rows, breaks):
            if len(run) and self._interval_ticks and run[0, TICK] != self._next_tick:
                self._end_interval()
            self._add_run(run)

    def take_intervals(self, most: int) -> Intervals:
        """Remove and return up to `most` of the oldest intervals, (n, columns, 3: minimum, maximum, mean).

        The unfinished interval is returned too if fewer than `most` finished ones wait.
        """
        if len(self._intervals) < most:
            self._end_interval()
        intervals, self._intervals = self._intervals[:most], self._intervals[most:]
        return np.stack(intervals) if intervals else np.empty((0, self._columns, len(STATISTICS)))

    def requeue(self, intervals: Intervals) -> None:
        """Put back intervals (n, columns, 3: minimum, maximum, mean) that could not be written, as the first ones."""
        self._intervals = [*intervals, *self._intervals]

    def _add_run(self, run: Real) -> None:
        """Add rows of consecutive ticks to the present interval, and begin another one after every `every` ticks."""
        while len(run):
            part, run = run[: self._every - self._interval_ticks], run[self._every - self._interval_ticks :]
            is_number = ~np.isnan(part)
            minimum, maximum = np.fmin.reduce(part, axis=0), np.fmax.reduce(part, axis=0)
            with np.errstate(over="ignore", invalid="ignore"):  # A record may hold any double.
                total = np.add.reduce(part, axis=0, where=is_number)
            if self._interval_ticks == 0:
                self._minimum, self._maximum = minimum, maximum
                self._total, self._number_count = total, np.zeros(self._columns)
            else:
                self._minimum, self._maximum = np.fmin(self._minimum, minimum), np.fmax(self._maximum, maximum)
                self._total = self._total + total
            self._number_count += np.count_nonzero(is_number, axis=0)
            self._interval_ticks, self._next_tick = self._interval_ticks + len(part), int(part[-1, TICK]) + 1
            if self._interval_ticks == self._every:
                self._end_interval()

    def _end_interval(self) -> None:
        """End the present interval, unless it has no tick, and queue minimum, maximum and mean of every column.

        All three are NaN for a column whose values are all NaN.
        """
        if self._interval_ticks == 0:
            return
        with np.errstate(invalid="ignore"):
            mean = np.where(self._number_count > 0, self._total / np.maximum(self._number_count, 1), np.nan)
        self._intervals.append(np.stack([self._minimum, self._maximum, mean], axis=1))
        self._interval_ticks = 0
