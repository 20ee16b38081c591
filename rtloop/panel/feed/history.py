"""Ring buffer of the last ticks of some signals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rtloop.client.ticks.tick_stretch import Stretch
from rtloop.foundation.arrays import Real


class History:
    """The last `ticks` ticks of `signals`, all of one run; lost ticks are NaN in every signal.

    Raises ValueError for less than one tick. `run` is the number of the run, −1 before the first.
    """

    def __init__(self, signals: Sequence[str], ticks: int) -> None:
        """Begin without ticks, with room for the last `ticks` ticks. Raises ValueError for less than one tick."""
        if ticks < 1:
            raise ValueError(f"history: {ticks} ticks; allowed: at least 1")
        self.signals = tuple(signals)
        self._values = np.full((len(self.signals), ticks), np.nan)
        self.run = -1
        self.end = 0
        """Number of the tick after the newest one."""

    def append(self, stretch: Stretch) -> None:
        """Add the next ticks in place of the oldest; lost ticks before them become NaN.

        Ticks of a new run replace all others. Raises ValueError if the stretch lacks a signal of the history.
        """
        columns = [stretch[name] for name in self.signals]
        if stretch.run != self.run:
            self._values[:] = np.nan
            self.run, self.end = stretch.run, stretch.first
        capacity = self._values.shape[1]
        self._values[:, np.arange(max(self.end, stretch.first - capacity), stretch.first) % capacity] = np.nan
        begin = max(stretch.end - capacity, stretch.first)
        columns_to_write = np.arange(begin, stretch.end) % capacity
        for row, column in zip(self._values, columns, strict=True):
            row[columns_to_write] = column[begin - stretch.first :]
        self.end = stretch.end

    def values_between(self, first: int, end: int, rows: Sequence[int] | None = None) -> Real:
        """Return a copy of ticks `first` … `end` − 1, (signals, end − first); NaN for lost, too old and future ticks.

        `rows` selects signals by their indices; None means all.
        """
        capacity = self._values.shape[1]
        source_rows = self._values if rows is None else [self._values[row] for row in rows]
        values = np.full((len(source_rows), max(end - first, 0)), np.nan)
        begin, available_end = max(first, self.end - capacity), min(end, self.end)
        while begin < available_end:  # At most twice: up to the end of the array, then from its beginning.
            column = begin % capacity
            count = min(available_end - begin, capacity - column)
            for target, row in zip(values, source_rows, strict=True):
                target[begin - first : begin - first + count] = row[column : column + count]
            begin += count
        return values
