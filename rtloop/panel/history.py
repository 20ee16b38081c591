"""The last ticks of some signals: what lies before a trigger, what rolls over the screen, what is captured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.panel.stretch import Stretch


class History:
    """The last `ticks` ticks of the `signals`, of one run; ticks that were lost are NaN in every signal."""

    def __init__(self, signals: Sequence[str], ticks: int) -> None:
        if ticks < 1:
            raise ValueError(f"history: {ticks} ticks; at least 1 is needed")
        self.signals = tuple(signals)
        self._values = np.full((len(self.signals), ticks), np.nan)
        self.run = -1
        self.end = 0
        """The tick behind the newest one."""

    def append(self, stretch: Stretch) -> None:
        """Add what was read; another run replaces all that was there. Raises ValueError, of an unknown signal."""
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
        """Values (signals, end − first), a copy; NaN for ticks that are lost, too old or still to come.

        `rows` says which of the signals, by their places among them; all by default.
        """
        capacity = self._values.shape[1]
        source_rows = self._values if rows is None else [self._values[row] for row in rows]
        values = np.full((len(source_rows), max(end - first, 0)), np.nan)
        begin, available_end = max(first, self.end - capacity), min(end, self.end)
        while begin < available_end:  # twice at most: up to the end of the array, and from its beginning on
            column = begin % capacity
            count = min(available_end - begin, capacity - column)
            for target, row in zip(values, source_rows, strict=True):
                target[begin - first : begin - first + count] = row[column : column + count]
            begin += count
        return values
