"""The last minute of ticks, with the extremes of blocks of ticks, from which long screens are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.client.ticks.tick_stretch import Stretch, column_index
from rtloop.foundation.arrays import Real
from rtloop.panel.feed.envelope import envelope
from rtloop.panel.feed.history import History

BLOCK = 32
"""Ticks of a block. A screen with at least FINEST_BLOCKS blocks for each pixel is drawn from blocks."""
FINEST_BLOCKS = 2
MAX_BYTES = 240 << 20
LONGEST_S = 60.0
SPARE_S = 12.0
"""Time kept beyond the longest screen, for the slowest client that is still served."""


class Points(NamedTuple):
    """Extremes `low` and `high` (signals, points) of the ticks from `tick` (points,) up to the next point."""

    tick: npt.NDArray[np.intp]
    low: Real
    high: Real


def history_ticks(columns: int, rate_hz: float) -> int:
    """Return the number of ticks to keep for a loop of `columns` signals: a multiple of BLOCK, at least one BLOCK.

    The ticks last for LONGEST_S + SPARE_S, or are as many as MAX_BYTES hold if these are fewer.
    """
    memory_ticks = int(MAX_BYTES / (columns * 8 * (1 + 2 / BLOCK)))
    return BLOCK * max(min(memory_ticks, int((LONGEST_S + SPARE_S) * rate_hz)) // BLOCK, 1)


def longest_view_s(columns: int, rate_hz: float) -> float:
    """Return the duration of the longest screen that can be drawn for a loop of `columns` signals, s."""
    return min(LONGEST_S, history_ticks(columns, rate_hz) / rate_hz * LONGEST_S / (LONGEST_S + SPARE_S))


class TickHistory:
    """The last `ticks` ticks, a multiple of BLOCK, of the signals of one run, and the extremes of their blocks."""

    def __init__(self, signals: Sequence[str], ticks: int) -> None:
        """Begin without ticks, with room for the last `ticks` ticks, a multiple of BLOCK."""
        self.history = History(signals, ticks)
        self._blocks = ticks // BLOCK
        self._low, self._high = np.full((2, len(signals), self._blocks), np.nan)

    @property
    def run(self) -> int:
        """Number of the run; −1 before the first."""
        return self.history.run

    @property
    def end(self) -> int:
        """Number of the tick after the newest one."""
        return self.history.end

    @property
    def begin(self) -> int:
        """Number of the oldest tick that the history can still hold: `end` less its capacity, at least 0.

        Ticks from `begin` on that were lost, or came before the first append, are NaN.
        """
        return max(self.end - self._blocks * BLOCK, 0)

    def append(self, stretch: Stretch) -> None:
        """Add the next ticks in place of the oldest, and update the extremes of their blocks.

        Ticks of a new run replace all others. Raises ValueError if the stretch lacks a signal of the history.
        """
        history = self.history
        previous_end = history.end if stretch.run == history.run else stretch.first
        history.append(stretch)
        end = -(-history.end // BLOCK)
        first = max(previous_end // BLOCK, end - self._blocks)
        values = history.values_between(first * BLOCK, end * BLOCK).reshape(len(history.signals), -1, BLOCK)
        indices = np.arange(first, end) % self._blocks
        self._low[:, indices], self._high[:, indices] = np.fmin.reduce(values, -1), np.fmax.reduce(values, -1)

    def values(self, signals: Sequence[str], first: int, end: int) -> Real:
        """Return a copy of ticks `first` … `end` − 1, (signals, end − first), in the order of `signals`.

        NaN for lost, too old and future ticks. Raises ValueError for an unknown signal.
        """
        return self.history.values_between(first, end, self._rows(signals))

    def points(self, signals: Sequence[str], first: int, end: int, pixels: int) -> Points:
        """Return the extremes of ticks `first` … `end` − 1 for `pixels` pixels; NaN for lost, too old and future ticks.

        With FINEST_BLOCKS blocks or more for each pixel, points are whole blocks: the first may begin before `first`,
        and the last may end after `end`. Raises ValueError for an unknown signal.
        """
        rows = self._rows(signals)
        if end - first < FINEST_BLOCKS * BLOCK * pixels:
            screen = envelope(self.history.values_between(first, end, rows), pixels)
            return Points(first + screen.sample, screen.low, screen.high)
        begin, count = first // BLOCK, -(-end // BLOCK) - first // BLOCK
        newest_end = -(-self.end // BLOCK)
        available = np.arange(max(begin, newest_end - self._blocks), min(begin + count, newest_end))
        low, high = np.full((2, len(rows), count), np.nan)
        for target, source in ((low, self._low), (high, self._high)):
            target[:, available - begin] = source[rows][:, available % self._blocks]
        lows, highs = envelope(low, pixels), envelope(high, pixels)
        return Points((begin + lows.sample) * BLOCK, lows.low, highs.high)

    def _rows(self, signals: Sequence[str]) -> list[int]:
        """Return the indices of signals, in their order. Raises ValueError for an unknown one."""
        return [column_index(name, self.history.signals) for name in signals]
