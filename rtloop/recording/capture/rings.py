"""Read the loop's rings from Python; each reader has its own cursor and counts lost slots."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.engine.memory import SharedBlock
from rtloop.engine.ring import drain


class RingReader:
    """Reader of the ring `name` of `block`, from slot number `position` on; `lost` counts slots overwritten unread."""

    def __init__(self, block: SharedBlock, name: str, position: int = 0) -> None:
        """Begin at slot number `position` of the ring `ticks`, `events` or `snapshots`; no slot is read yet."""
        self._ring = block.ring(name)
        self.position, self.lost = position, 0

    def take_into(self, out: npt.NDArray[np.generic]) -> tuple[int, int]:
        """Copy the next slots into `out`, at most len(out), and move `position` behind them.

        Returns (slots copied, slots lost before them), and adds the lost slots to the attribute `lost`.
        """
        copied, first, lost = drain(self._ring, self.position, out)
        self.position = int(first) + copied
        self.lost += int(lost)
        return copied, int(lost)

    def take(self) -> npt.NDArray[Any]:
        """Return a copy of all new slots, possibly none, and move `position` behind them.

        If the loop has written more than the ring holds, the oldest new slots are lost and added to `lost`.
        """
        slots = self._ring.slots
        if int(self._ring.head[0]) == self.position:  # The usual case, without a call into compiled code.
            return slots[:0]
        out = np.empty(slots.shape, slots.dtype)
        copied, _ = self.take_into(out)
        return out[:copied]
