"""Account of the ticks read from a file: each must come once, in order, as many as its recorder counted."""

from __future__ import annotations

from rtloop.recording.file.mcap.container import DamagedChunk
from rtloop.recording.file.topics.format import Totals
from rtloop.recording.file.topics.ticks import LARGEST, Ticks


class TickAccount:
    """Account of the ticks read from one file: whether they are in order, and as many as the recorder counted."""

    def __init__(self, first_tick: int, totals: Totals | None, end_of_repetition: int = 0) -> None:
        """Expect ticks from `first_tick` on, and the counts `totals` of the recorder, None for an unfinished file.

        Ticks before `end_of_repetition` are read from another file; here they are only counted.
        """
        self._next_tick, self._tick_count, self._end_of_repetition = first_tick, 0, end_of_repetition
        self._end = totals["ticks_executed"] if totals else LARGEST
        self._ticks_logged = totals and totals["ticks_logged"]

    def add(self, chunk: Ticks) -> Ticks | None:
        """Count the ticks of a chunk. Returns them without those before `end_of_repetition`; None if none remains.

        Raises DamagedChunk if the remaining ticks begin before the next expected tick, or reach the end of the run that
        the recorder stored.
        """
        ticks = chunk.from_tick(self._end_of_repetition) if chunk.first < self._end_of_repetition else chunk
        if ticks is None:
            self._tick_count += len(chunk.rows)
            return None
        if ticks.first < self._next_tick:
            raise DamagedChunk(
                f"ticks out of order: the chunk begins with tick {ticks.first}; allowed: {self._next_tick} or later"
            )
        if ticks.last >= self._end:
            raise DamagedChunk(
                f"too many ticks: the chunk ends with tick {ticks.last}; allowed: up to tick {self._end - 1}, the last "
                "tick of the run"
            )
        self._next_tick = ticks.last + 1
        self._tick_count += len(chunk.rows)
        return ticks

    @property
    def shortage_problem(self) -> str | None:
        """Message about a number of read ticks that differs from the recorder's count.

        None if the numbers agree, or for an unfinished file.
        """
        if self._ticks_logged in (None, self._tick_count):
            return None
        return f"the file holds {self._tick_count} ticks; the recorder wrote {self._ticks_logged}"
