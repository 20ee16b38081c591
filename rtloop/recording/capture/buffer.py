"""Ticks that were drained from the ring and are not written yet, and the time at which each tick was due."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.recording.capture.rings import RingReader
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.overview import MAXIMUM, MINIMUM, Intervals
from rtloop.recording.file.topics.ticks import missing_ranges
from rtloop.signals import DEADLINE, TICK

NS_PER_S = 1e9


class TickTime(NamedTuple):
    """A tick and its deadline, in ns since the start of the run."""

    tick: int
    time_ns: int


class TickSpans:
    """Ticks and deadlines that rows or intervals cover; `tick_count` is the number of covered ticks."""

    def __init__(self, rows: Real, intervals: Intervals | None) -> None:
        """Take rows (n, columns) of ticks, or, if not None, intervals (n, columns, 3: minimum, maximum, mean)."""
        if intervals is None:
            self._first = self._last = rows[:, : DEADLINE + 1]
            self.tick_count = len(rows)
        else:
            self._first, self._last = intervals[:, : DEADLINE + 1, MINIMUM], intervals[:, : DEADLINE + 1, MAXIMUM]
            self.tick_count = int((self._last[:, TICK] - self._first[:, TICK] + 1).sum())

    @property
    def end(self) -> int:
        """Number of the tick after the last covered tick; only defined if a tick is covered."""
        return int(self._last[-1, TICK]) + 1

    def gaps(self, expected: int) -> list[tuple[int, int]]:
        """Return the ranges (first tick, count) of missing ticks, from tick `expected` to the last covered tick."""
        if self.tick_count and self.end - expected == self.tick_count:  # The usual case: the ticks ascend.
            return []
        return missing_ranges(self._first[:, TICK], expected, self._last[:, TICK])

    def tick_time(self, tick: int, rate_hz: float) -> TickTime:
        """Return `tick` with its deadline, extrapolated at `rate_hz` from the end of the row or interval before `tick`.

        A row or interval must end before `tick`.
        """
        row = self._last[np.searchsorted(self._last[:, TICK], tick) - 1]
        return TickTime(tick, round(row[DEADLINE] + (tick - row[TICK]) * NS_PER_S / rate_hz))


class TickBuffer:
    """Buffer of rows (n, columns) float64, ordered by tick, with room for a whole number of chunks."""

    def __init__(self, columns: list[str], rate_hz: float, chunks: int = 1) -> None:
        """Make an empty buffer for `chunks` chunks of ticks of `columns`; deadlines are extrapolated at `rate_hz`."""
        self.chunk_rows = format.chunk_rows(columns)
        self._room = np.empty((chunks * self.chunk_rows, len(columns)))
        self._begin = self._end = 0
        self._rate_hz = rate_hz
        self._anchor = (0.0, 0.0)

    def __len__(self) -> int:
        """Number of ticks in the buffer."""
        return self._end - self._begin

    @property
    def rows(self) -> Real:
        """All rows (n, columns) in the buffer: a view, valid until the next `take_from`."""
        return self._room[self._begin : self._end]

    @property
    def end(self) -> int:
        """Number of the tick after the last row; only defined if the buffer is not empty."""
        return int(self._room[self._end - 1, TICK]) + 1

    @property
    def free_rows(self) -> int:
        """Number of ticks for which the buffer still has room."""
        return len(self._room) - len(self)

    def take_from(self, reader: RingReader) -> int:
        """Append the next ticks of the ring, as many as the buffer has room for.

        Returns the number of ticks appended plus the number of ticks lost in the ring before them.
        """
        if self._begin:
            remaining = self.rows.copy()
            self._begin, self._end = 0, len(remaining)
            self._room[: self._end] = remaining
        copied, lost = reader.take_into(self._room[self._end :])
        self._end += copied
        return copied + lost

    def count_before(self, tick: int) -> int:
        """Count the rows in the buffer whose tick number is below `tick`."""
        return int(np.searchsorted(self.rows[:, TICK], tick))

    def drop(self, count: int) -> None:
        """Discard the first `count` rows, at most `len()`; `tick_time` can extrapolate from the last discarded row."""
        if count:
            self._begin += count
            self._anchor = (self._room[self._begin - 1, TICK], self._room[self._begin - 1, DEADLINE])

    def tick_time(self, tick: int) -> TickTime:
        """Return `tick` with its deadline, taken from its row or extrapolated from the last row before it.

        Without a row before `tick`, the last dropped row is the base; before any was dropped, tick 0 with deadline 0.
        """
        base_tick, base_ns = self._anchor
        rows = self.rows
        row = int(np.searchsorted(rows[:, TICK], tick, side="right")) - 1
        if row >= 0:
            base_tick, base_ns = rows[row, TICK], rows[row, DEADLINE]
        return TickTime(tick, round(base_ns + (tick - base_tick) * NS_PER_S / self._rate_hz))
