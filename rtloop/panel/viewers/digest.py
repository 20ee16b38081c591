"""The extremes and the last value of every signal since they were taken, however many ticks that is about."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.panel.stretch import Stretch
from rtloop.panel.views.service import Description
from rtloop.panel.views.tick_history import TickHistory
from rtloop.signals import COMMON_SIGNALS, TICK


class SignalDigest(NamedTuple):
    """`extremes` (signals, 3): min, max, last; NaN where there was no number. `ticks` they are about, up to `tick`."""

    tick: int
    ticks: int
    lost: int
    extremes: Real


class Digest:
    """Fed with every tick by the feed, under its lock; `generation` goes up with other signals."""

    def __init__(self) -> None:
        self.names: tuple[str, ...] = ()
        self.generation = 0
        self._columns: list[int] = []
        self._current: SignalDigest | None = None

    def begin(self, loop: Description) -> None:
        """A run of a loop begins."""
        names = tuple(name for name in loop.names if name != COMMON_SIGNALS[TICK].name)
        if names != self.names:
            self.names, self._columns = names, [loop.names.index(name) for name in names]
            self.generation += 1
        self._current = None

    def feed(self, stretch: Stretch, commands: Sequence[int]) -> None:
        """Ticks came."""
        rows = stretch.rows[:, self._columns]
        if len(rows) == 0:
            return
        low, high, count, lost = np.fmin.reduce(rows), np.fmax.reduce(rows), len(rows), stretch.lost
        if (previous := self._current) is not None:
            low, high = np.fmin(low, previous.extremes[:, 0]), np.fmax(high, previous.extremes[:, 1])
            count, lost = count + previous.ticks, lost + previous.lost
        self._current = SignalDigest(stretch.end - 1, count, lost, np.column_stack([low, high, rows[-1]]))

    def end_run(self, past: TickHistory) -> None:
        """The run is over: what was not taken is gone with it."""
        self._current = None

    def take(self) -> SignalDigest | None:
        """What came since the last time; None where nothing did."""
        digest, self._current = self._current, None
        return digest
