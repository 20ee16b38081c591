"""Reading the loop's rings from Python: each reader has its cursor and counts what it lost."""

from __future__ import annotations

from typing import Any

import numpy as np

from rtloop.engine.memory import SharedBlock
from rtloop.engine.ring import drain


class RingReader:
    """Reads the ring `name` of `block` from `position` on."""

    def __init__(self, block: SharedBlock, name: str, position: int = 0) -> None:
        self._ring = block.ring(name)
        self.position, self.lost = position, 0

    def take_into(self, out: np.ndarray[Any, Any]) -> tuple[int, int]:
        """Copy whole slots into `out` as far as it reaches; returns (slots copied, slots lost in front of them)."""
        copied, first, lost = drain(self._ring, self.position, out)
        self.position = int(first) + copied
        self.lost += int(lost)
        return copied, int(lost)

    def take(self) -> np.ndarray[Any, Any]:
        """What is there, at most one ring full, as an array of its own."""
        slots = self._ring.slots
        if int(self._ring.head[0]) == self.position:  # the usual case, without a call into compiled code
            return slots[:0]
        out = np.empty(slots.shape, slots.dtype)
        copied, _ = self.take_into(out)
        return out[:copied]
