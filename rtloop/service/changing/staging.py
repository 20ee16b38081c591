"""What a running loop reads from shared memory: it must not change again before the loop has read it."""

from __future__ import annotations

import threading

import numpy as np

from rtloop.engine.memory import SharedBlock
from rtloop.engine.messages import Kind
from rtloop.engine.ring import drain
from rtloop.service.desk import Desk, Refused, Taken
from rtloop.signals import MODE, Mode


class Staging:
    """The shared block of a loop, and the desk that tells it what was put there; `lock` is held meanwhile."""

    def __init__(self, block: SharedBlock, desk: Desk) -> None:
        self.block, self.desk = block, desk
        self.lock = threading.Lock()
        self._unsettled_tick: int | None = None

    def require_settled(self) -> None:
        """Raise Refused while the loop may still take what was staged before."""
        if self._unsettled_tick is not None and int(self.block["ticks_head"][0]) <= self._unsettled_tick + 1:
            raise Refused("an earlier change has been taken by the loop, which stands still")
        self._unsettled_tick = None

    def submit(self, kind: Kind, number: int, values: list[float], change: str | None = None) -> int:
        """Tell it what was staged for an axis; returns the tick. Raises Refused, and Taken where it may yet read it.

        `change` as in `Desk.submit`.
        """
        try:
            return self.desk.submit(kind, axis=number, values=values, change=change)
        except Taken:
            self._unsettled_tick = int(self.block["ticks_head"][0])
            raise

    @property
    def in_raw_mode(self) -> bool:
        """At the newest tick."""
        ring = self.block.ring("ticks")
        rows = np.empty((1, ring.slots.shape[1]))
        copied, _, _ = drain(ring, max(int(ring.head[0]) - 1, 0), rows)
        return copied == 1 and rows[0, MODE] == Mode.RAW
