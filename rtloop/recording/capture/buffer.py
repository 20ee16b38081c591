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
        """The tick after the last one covered; only defined if there is one."""
        return int(self._last[-1, TICK]) + 1

    def gaps(self, expected: int) -> list[tuple[int, int]]:
        """Return the missing ranges (first tick, count) from tick `expected` on, before and between the ticks."""
        if self.tick_count and self.end - expected == self.tick_count:  # The usual case: the ticks ascend.
            return []
        return missing_ranges(self._first[:, TICK], expected, self._last[:, TICK])

    def tick_time(self, tick: int, rate_hz: float) -> TickTime:
        """Return `tick` with its deadline, extrapolated at `rate_hz` from the last covered tick before it.

        There must be a covered tick before it.
        """
        row = self._last[np.searchsorted(self._last[:, TICK], tick) - 1]
        return TickTime(tick, round(row[DEADLINE] + (tick - row[TICK]) * NS_PER_S / rate_hz))


class TickBuffer:
    """Buffer of at most one chunk of rows (n, columns) float64, ordered by tick."""

    def __init__(self, columns: list[str], rate_hz: float) -> None:
        """Make an empty buffer for ticks of `columns`; deadlines are extrapolated at `rate_hz`."""
        self._rows = np.empty((format.chunk_rows(columns), len(columns)))
        self._row_count, self._rate_hz = 0, rate_hz
        self._anchor = (0.0, 0.0)

    def __len__(self) -> int:
        """Number of ticks in the buffer."""
        return self._row_count

    @property
    def end(self) -> int:
        """The tick after the last one; only defined if the buffer is not empty."""
        return int(self._rows[self._row_count - 1, TICK]) + 1

    @property
    def free_rows(self) -> int:
        """Number of ticks for which the buffer still has room."""
        return len(self._rows) - self._row_count

    def take_from(self, reader: RingReader) -> int:
        """Append ticks from the ring, as many as there is room for.

        Returns the number of ticks appended plus the number of ticks lost in the ring before them.
        """
        copied, lost = reader.take_into(self._rows[self._row_count :])
        self._row_count += copied
        return copied + lost

    def first_rows(self, count: int) -> Real:
        """Return the first `count` rows, at most `len()`, as (count, columns): a view, valid until the next `drop`."""
        return self._rows[:count]

    def count_before(self, tick: int) -> int:
        """Count the rows before `tick`."""
        return int(np.searchsorted(self._rows[: self._row_count, TICK], tick))

    def drop(self, count: int) -> None:
        """Discard the first `count` rows, at most `len()`; `tick_time` still extrapolates from the last of them."""
        if count:
            self._anchor = (self._rows[count - 1, TICK], self._rows[count - 1, DEADLINE])
        remaining = self._row_count - count
        self._rows[:remaining] = self._rows[count : self._row_count].copy()
        self._row_count = remaining

    def tick_time(self, tick: int) -> TickTime:
        """Return `tick` with its deadline, taken from its row or extrapolated from the last row before it.

        Without a row before it, the base is the last dropped row; before any was dropped, tick 0 with deadline 0.
        """
        base_tick, base_ns = self._anchor
        row = int(np.searchsorted(self._rows[: self._row_count, TICK], tick, side="right")) - 1
        if row >= 0:
            base_tick, base_ns = self._rows[row, TICK], self._rows[row, DEADLINE]
        return TickTime(tick, round(base_ns + (tick - base_tick) * NS_PER_S / self._rate_hz))
