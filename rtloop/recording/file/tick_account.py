"""An account of the ticks that are read from a file: each once, in order, as many as its recorder counted."""

from __future__ import annotations

from typing import Any

from rtloop.recording.file.mcap.container import DamagedChunk
from rtloop.recording.file.topics.ticks import LARGEST, Ticks


class TickAccount:
    """From `first_tick` on; `totals` are what was counted at the file's end, None where it has none.

    Ticks before `end_of_repetition` are taken from another file, and only counted here.
    """

    def __init__(self, first_tick: int, totals: dict[str, Any] | None, end_of_repetition: int = 0) -> None:
        self._next_tick, self._tick_count, self._end_of_repetition = first_tick, 0, end_of_repetition
        self._end = totals["ticks_executed"] if totals else LARGEST
        self._ticks_logged = totals and totals["ticks_logged"]

    def add(self, chunk: Ticks) -> Ticks | None:
        """Count a chunk; returns the ticks to be taken from it. Raises DamagedChunk where it does not come next."""
        ticks = chunk.from_tick(self._end_of_repetition) if chunk.first < self._end_of_repetition else chunk
        if ticks is None:
            self._tick_count += len(chunk.rows)
            return None
        if ticks.first < self._next_tick:
            raise DamagedChunk(f"out of order: tick {ticks.first}, where {self._next_tick} or a later one comes next")
        if ticks.last >= self._end:
            raise DamagedChunk(f"out of order: tick {ticks.last}, but the run ended before tick {self._end}")
        self._next_tick = ticks.last + 1
        self._tick_count += len(chunk.rows)
        return ticks

    @property
    def shortage_problem(self) -> str | None:
        """What to say where another number was read than written."""
        if self._ticks_logged in (None, self._tick_count):
            return None
        return f"it holds {self._tick_count} of the {self._ticks_logged} ticks that were written"
