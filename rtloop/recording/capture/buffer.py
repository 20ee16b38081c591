"""Ticks that were drained and are not written yet, and when each tick was due."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rtloop.recording.capture.rings import RingReader
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.overview import MAXIMUM, MINIMUM, Intervals
from rtloop.recording.file.topics.ticks import missing_ranges
from rtloop.signals import DEADLINE, TICK

NS_PER_S = 1e9
Rows = np.ndarray[Any, Any]


class TickTime(NamedTuple):
    """A tick, and when it is due, in ns since the start."""

    tick: int
    time_ns: int


class TickSpans:
    """Of which ticks, and times, rows (n, columns) are, or intervals (n, columns, 3) in their place."""

    def __init__(self, rows: Rows, intervals: Intervals | None) -> None:
        if intervals is None:
            self._first = self._last = rows[:, : DEADLINE + 1]
        else:
            self._first, self._last = intervals[:, : DEADLINE + 1, MINIMUM], intervals[:, : DEADLINE + 1, MAXIMUM]
        self.tick_count = int((self._last[:, TICK] - self._first[:, TICK] + 1).sum())

    @property
    def end(self) -> int:
        """The tick behind the last one."""
        return int(self._last[-1, TICK]) + 1

    def gaps(self, expected: int) -> list[tuple[int, int]]:
        """(first tick, ticks) of all that is missing between them, where `expected` is to come first."""
        begins, ends = self._first[:, TICK], np.concatenate([[expected], self._last[:-1, TICK] + 1])
        if self._first is self._last:
            return missing_ranges(begins, expected) if len(begins) else []
        return [(int(ends[row]), int(begins[row] - ends[row])) for row in np.flatnonzero(begins != ends[: len(begins)])]

    def tick_time(self, tick: int, rate_hz: float) -> TickTime:
        """A tick behind some of them, and its time by the last one before it."""
        row = self._last[np.searchsorted(self._last[:, TICK], tick) - 1]
        return TickTime(tick, round(row[DEADLINE] + (tick - row[TICK]) * NS_PER_S / rate_hz))


class TickBuffer:
    """Rows (n, columns) float64 in the order of their ticks, one chunk at most."""

    def __init__(self, columns: list[str], rate_hz: float) -> None:
        self._rows = np.empty((format.chunk_rows(columns), len(columns)))
        self._row_count, self._rate_hz = 0, rate_hz
        self._anchor = (0.0, 0.0)

    def __len__(self) -> int:
        return self._row_count

    @property
    def end(self) -> int:
        """The tick behind the last one, if there is any."""
        return int(self._rows[self._row_count - 1, TICK]) + 1

    @property
    def free_rows(self) -> int:
        """Ticks that can still be taken."""
        return len(self._rows) - self._row_count

    def take_from(self, reader: RingReader) -> int:
        """Take what there is room for; returns the ticks taken or found lost."""
        copied, lost = reader.take_into(self._rows[self._row_count :])
        self._row_count += copied
        return copied + lost

    def first_rows(self, count: int) -> np.ndarray[Any, Any]:
        """The first `count` rows, valid until they are dropped."""
        return self._rows[:count]

    def rows_before(self, tick: int) -> int:
        """How many rows come before `tick`."""
        return int(np.searchsorted(self._rows[: self._row_count, TICK], tick))

    def drop(self, count: int) -> None:
        """Forget the first `count` rows; those behind them move to the front."""
        if count:
            self._anchor = (self._rows[count - 1, TICK], self._rows[count - 1, DEADLINE])
        remaining = self._row_count - count
        self._rows[:remaining] = self._rows[count : self._row_count].copy()
        self._row_count = remaining

    def time_ns(self, tick: int) -> int:
        """When `tick` was due, since the start: from its row or the last one before it, else by the period."""
        base_tick, base_ns = self._anchor
        row = int(np.searchsorted(self._rows[: self._row_count, TICK], tick, side="right")) - 1
        if row >= 0:
            base_tick, base_ns = self._rows[row, TICK], self._rows[row, DEADLINE]
        return round(base_ns + (tick - base_tick) * NS_PER_S / self._rate_hz)

    def tick_time(self, tick: int) -> TickTime:
        """A tick and its time."""
        return TickTime(tick, self.time_ns(tick))
