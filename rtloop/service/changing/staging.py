"""Staging of data for a running loop in shared memory, which must not change before the loop has read it."""

from __future__ import annotations

import numpy as np

from rtloop.engine.memory import SharedBlock
from rtloop.engine.messages import Kind
from rtloop.engine.ring import drain
from rtloop.foundation import timing
from rtloop.foundation.arrays import Real
from rtloop.service.desk import Desk, Refusal, UnconfirmedCommand
from rtloop.signals import MODE, Mode


class Staging:
    """The shared block of a loop and the desk that announces staged data; hold `lock` while staging."""

    def __init__(self, block: SharedBlock, desk: Desk) -> None:
        """Use the `block` of a loop and the `desk` that sends to it; nothing is staged yet."""
        self.block, self.desk = block, desk
        self.lock = timing.lock()
        self._unsettled_tick: int | None = None

    def require_settled(self) -> None:
        """Raise Refusal if the loop has executed less than two ticks since the last UnconfirmedCommand of `submit`: it
        may still read the data that were staged for that command.
        """
        if self._unsettled_tick is not None and int(self.block["ticks_head"][0]) <= self._unsettled_tick + 1:
            raise Refusal("the loop stands still and has not finished an earlier change; try again when the loop runs")
        self._unsettled_tick = None

    def submit(self, kind: Kind, number: int, values: list[float], change: str | None = None) -> int:
        """Send the command `kind`, with `values`, for the data that are staged for axis `number`. Returns the tick at
        which the loop has loaded the data.

        `change` and errors as in `Desk.submit`. After an UnconfirmedCommand, `require_settled` refuses for two ticks.
        """
        try:
            return self.desk.submit(kind, axis=number, values=values, change=change)
        except UnconfirmedCommand:
            self._unsettled_tick = int(self.block["ticks_head"][0])
            raise

    @property
    def newest_record(self) -> Real | None:
        """Record of the newest tick (columns,); None before the first tick."""
        ring = self.block.ring("ticks")
        rows = np.empty((1, ring.slots.shape[1]))
        copied, _, _ = drain(ring, max(int(ring.head[0]) - 1, 0), rows)
        return rows[0] if copied == 1 else None

    @property
    def in_raw_mode(self) -> bool:
        """Whether the newest tick was in raw mode; False before the first tick."""
        record = self.newest_record
        return record is not None and record[MODE] == Mode.RAW
