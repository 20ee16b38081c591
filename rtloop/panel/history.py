"""The last ticks of some signals: what lies before a trigger, what rolls over the screen, what is captured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rtloop.hil.modal import Real
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

    def take(self, stretch: Stretch) -> None:
        """Add what was read; another run replaces all that was there. Raises ValueError, of an unknown signal."""
        columns = [stretch[name] for name in self.signals]
        if stretch.run != self.run:
            self._values[:] = np.nan
            self.run, self.end = stretch.run, stretch.first
        capacity = self._values.shape[1]
        self._values[:, np.arange(max(self.end, stretch.first - capacity), stretch.first) % capacity] = np.nan
        begin = max(stretch.end - capacity, stretch.first)
        places = np.arange(begin, stretch.end) % capacity
        for row, column in zip(self._values, columns, strict=True):
            row[places] = column[begin - stretch.first :]
        self.end = stretch.end

    def between(self, first: int, end: int, rows: Sequence[int] | None = None) -> Real:
        """Values (signals, end − first), a copy; NaN for ticks that are lost, too old or still to come.

        `rows` says which of the signals, by their places among them; all by default.
        """
        capacity = self._values.shape[1]
        kept = self._values if rows is None else [self._values[row] for row in rows]
        values = np.full((len(kept), max(end - first, 0)), np.nan)
        begin, beyond = max(first, self.end - capacity), min(end, self.end)
        while begin < beyond:  # twice at most: up to the end of the array, and from its beginning on
            place = begin % capacity
            count = min(beyond - begin, capacity - place)
            for value, row in zip(values, kept, strict=True):
                value[begin - first : begin - first + count] = row[place : place + count]
            begin += count
        return values
