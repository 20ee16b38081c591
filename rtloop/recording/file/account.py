"""An account of the ticks that are read from a file: each once, in order, as many as its recorder counted."""

from __future__ import annotations

from typing import Any

from rtloop.recording.file.mcap.container import DamagedChunk
from rtloop.recording.file.topics.ticks import LARGEST, Ticks


class Account:
    """From `first_tick` on; `totals` are what was counted at the file's end, None where it has none.

    Ticks before `repeated_before` are taken from another file, and only counted here.
    """

    def __init__(self, first_tick: int, totals: dict[str, Any] | None, repeated_before: int = 0) -> None:
        self._next, self._count, self._repeated_before = first_tick, 0, repeated_before
        self._end = totals["ticks_executed"] if totals else LARGEST
        self._written = totals and totals["ticks_logged"]

    def add(self, chunk: Ticks) -> Ticks | None:
        """Count a chunk; returns the ticks to be taken from it. Raises DamagedChunk where it does not come next."""
        ticks = chunk.since(self._repeated_before) if chunk.first < self._repeated_before else chunk
        if ticks is None:
            self._count += len(chunk.rows)
            return None
        if ticks.first < self._next:
            raise DamagedChunk(f"out of order: tick {ticks.first}, where {self._next} or a later one comes next")
        if ticks.last >= self._end:
            raise DamagedChunk(f"out of order: tick {ticks.last}, but the run ended before tick {self._end}")
        self._next = ticks.last + 1
        self._count += len(chunk.rows)
        return ticks

    @property
    def shortage(self) -> str | None:
        """What to say where another number was read than written."""
        if self._written in (None, self._count):
            return None
        return f"it holds {self._count} of the {self._written} ticks that were written"
