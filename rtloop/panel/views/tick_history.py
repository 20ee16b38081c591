"""What was read of a loop: its last ticks, and the extremes of blocks of them, from which long screens are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.panel.envelope import envelope
from rtloop.panel.history import History
from rtloop.panel.stretch import Stretch, column_index

BLOCK = 32
"""Ticks. A screen with at least FINEST_BLOCKS of them to a pixel is drawn from blocks."""
FINEST_BLOCKS = 2
MAX_BYTES = 240 << 20
LONGEST_S = 60.0
SPARE_S = 12.0
"""Kept beyond the longest screen, for a client that is as slow as it may be."""


class Points(NamedTuple):
    """Extremes (signals, points) of the ticks from `tick` (points,) on, up to the next point's."""

    tick: npt.NDArray[np.intp]
    low: Real
    high: Real


def history_ticks(columns: int, rate_hz: float) -> int:
    """So many as a screen of LONGEST_S needs, or as MOST_BYTES hold."""
    memory_ticks = int(MAX_BYTES / (columns * 8 * (1 + 2 / BLOCK)))
    return BLOCK * max(min(memory_ticks, int((LONGEST_S + SPARE_S) * rate_hz)) // BLOCK, 1)


def longest_view_s(columns: int, rate_hz: float) -> float:
    """The longest screen that can be drawn."""
    return min(LONGEST_S, history_ticks(columns, rate_hz) / rate_hz * LONGEST_S / (LONGEST_S + SPARE_S))


class TickHistory:
    """The last `ticks`, a number of whole blocks, of the signals of one run."""

    def __init__(self, signals: Sequence[str], ticks: int) -> None:
        self.history = History(signals, ticks)
        self._blocks = ticks // BLOCK
        self._low = np.full((len(signals), self._blocks), np.nan)
        self._high = np.full((len(signals), self._blocks), np.nan)

    @property
    def run(self) -> int:
        """Which run it is of; −1 before there is any."""
        return self.history.run

    @property
    def end(self) -> int:
        """The tick behind the newest one."""
        return self.history.end

    @property
    def begin(self) -> int:
        """The first tick that can be kept still."""
        return max(self.end - self._blocks * BLOCK, 0)

    def append(self, stretch: Stretch) -> None:
        """Add what was read. Raises ValueError, of an unknown signal."""
        history = self.history
        previous_end = history.end if stretch.run == history.run else stretch.first
        history.append(stretch)
        first, end = previous_end // BLOCK, -(-history.end // BLOCK)
        first = max(first, end - self._blocks)
        values = history.values_between(first * BLOCK, end * BLOCK).reshape(len(history.signals), -1, BLOCK)
        block_indices = np.arange(first, end) % self._blocks
        self._low[:, block_indices], self._high[:, block_indices] = (
            np.fmin.reduce(values, -1),
            np.fmax.reduce(values, -1),
        )

    def values(self, signals: Sequence[str], first: int, end: int) -> Real:
        """Every tick (signals, end − first); NaN for those that are not there. Raises ValueError."""
        return self.history.values_between(first, end, [column_index(name, self.history.signals) for name in signals])

    def points(self, signals: Sequence[str], first: int, end: int, pixels: int) -> Points:
        """Of ticks `first` … `end` − 1 on `pixels` pixels; NaN for ticks that are lost, too old or still to come.

        Where there are many ticks to a pixel, points begin at multiples of BLOCK, the first of them at or before
        `first`. Raises ValueError.
        """
        rows = [column_index(name, self.history.signals) for name in signals]
        if end - first < FINEST_BLOCKS * BLOCK * pixels:
            screen = envelope(self.history.values_between(first, end, rows), pixels)
            return Points(first + screen.sample, screen.low, screen.high)
        begin, count = first // BLOCK, -(-end // BLOCK) - first // BLOCK
        newest_end = -(-self.end // BLOCK)
        available = np.arange(max(begin, newest_end - self._blocks), min(begin + count, newest_end))
        low, high = np.full((2, len(rows), count), np.nan)
        block_indices = available % self._blocks
        low[:, available - begin], high[:, available - begin] = (
            self._low[rows][:, block_indices],
            self._high[rows][:, block_indices],
        )
        lows, highs = envelope(low, pixels), envelope(high, pixels)
        return Points((begin + lows.sample) * BLOCK, lows.low, highs.high)
