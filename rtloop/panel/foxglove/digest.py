"""Extremes and last value of every signal since the previous digest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rtloop.client.ticks.tick_stretch import Stretch
from rtloop.foundation.arrays import Real
from rtloop.panel.feed.tick_history import TickHistory
from rtloop.panel.service.service import Description
from rtloop.signals import COMMON_SIGNALS, TICK


class SignalDigest(NamedTuple):
    """Extremes (signals, 3) of `ticks` ticks, the newest of them `tick`: min, max, last; NaN without a finite value.

    `lost` further ticks between them were overwritten before they could be read.
    """

    tick: int
    ticks: int
    lost: int
    extremes: Real


class Digest:
    """Collector of the extremes and last values of all ticks since the last `take`.

    `names` are the signals except tick; `generation` is 0 before the first loop, and grows by one whenever `names`
    changes.
    """

    def __init__(self) -> None:
        """Begin without signals and without ticks, before the first loop."""
        self.names: tuple[str, ...] = ()
        self.generation = 0
        self._columns: list[int] = []
        self._current: SignalDigest | None = None

    def begin(self, loop: Description) -> None:
        """Begin a run of the described loop: discard ticks that were not taken.

        If its signals differ from the ones before, `names` is replaced and `generation` grows by one.
        """
        names = tuple(name for name in loop.names if name != COMMON_SIGNALS[TICK].name)
        if names != self.names:
            self.names, self._columns = names, [loop.names.index(name) for name in names]
            self.generation += 1
        self._current = None

    def feed(self, stretch: Stretch, commands: Sequence[int]) -> None:
        """Add the next ticks to the digest; `commands` are not used."""
        rows = stretch.rows[:, self._columns]
        if len(rows) == 0:
            return
        low, high, count, lost = np.fmin.reduce(rows), np.fmax.reduce(rows), len(rows), stretch.lost
        if (previous := self._current) is not None:
            low, high = np.fmin(low, previous.extremes[:, 0]), np.fmax(high, previous.extremes[:, 1])
            count, lost = count + previous.ticks, lost + previous.lost
        self._current = SignalDigest(stretch.end - 1, count, lost, np.column_stack([low, high, rows[-1]]))

    def end_run(self, past: TickHistory) -> None:
        """End the run and discard its ticks that were not taken."""
        self._current = None

    def take(self) -> SignalDigest | None:
        """Remove and return the digest of all ticks since the last call; None without ticks."""
        digest, self._current = self._current, None
        return digest
