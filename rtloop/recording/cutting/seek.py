"""Find a tick in a file by bisection, without reading the whole file."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from rtloop.recording.file.reader import Reader, Rows
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.events import FINAL
from rtloop.recording.file.topics.format import EVENTS, Totals
from rtloop.recording.file.topics.ticks import Ticks
from rtloop.signals import DEADLINE, TICK

CACHED_SPANS = 1 << 14


class ChunkSpan(NamedTuple):
    """First and last tick of a chunk, and their deadlines in ns since the start of the run."""

    first: int
    last: int
    first_ns: float
    last_ns: float


class ChunkSeeker:
    """Search in an open file; a place is the index of a chunk. The reader reports damaged chunks.

    `span(place)` and `chunk(place)` are `_read_span` and `_read_chunk` with a cache.
    """

    def __init__(self, reader: Reader) -> None:
        """Search in the file of `reader`, which must be tolerant; no chunk is read yet."""
        self.reader = reader
        self.span = lru_cache(CACHED_SPANS)(self._read_span)
        self.chunk = lru_cache(2)(self._read_chunk)
        self.damage: dict[int, list[str]] = {}
        """Faults of the chunks that were read, by place."""

    @property
    def end(self) -> int:
        """Number of chunks in the file, which is the place after the last chunk."""
        return len(self.reader.entries)

    def first_span(self) -> ChunkSpan | None:
        """Span of the first undamaged chunk with ticks; None without such a chunk."""
        return next(filter(None, map(self.span, range(self.end))), None)

    def last_span(self) -> ChunkSpan | None:
        """Span of the last undamaged chunk with ticks; None without such a chunk."""
        return next(filter(None, map(self.span, reversed(range(self.end)))), None)

    def final_totals(self) -> Totals | None:
        """Totals as `Reader.totals`, from the last chunk alone; None if this chunk is damaged or holds no totals."""
        content = self.chunk(self.end - 1)
        events = (
            [json.loads(message.payload) for message in content if message.channel == EVENTS]
            if isinstance(content, list)
            else []
        )
        return next((event["what"] for event in reversed(events) if event["kind"] in FINAL), None)

    def find_place(self, tick: int) -> int:
        """Index of the first chunk with `tick` or a later tick; the number of chunks if there is none."""
        return self._first_place(lambda span: span.last >= tick)

    def has_tick(self, tick: int) -> bool:
        """Whether an undamaged chunk of the file holds `tick`."""
        return len(self.rows(self.find_place(tick), tick, tick + 1)) > 0

    def first_tick_due(self, time_ns: float) -> int | None:
        """First tick with a deadline at or after `time_ns` since the start of the run; None if there is none."""
        place = self._first_place(lambda span: span.last_ns >= time_ns)
        rows = self._all_rows(place)
        due_rows = rows[rows[:, DEADLINE] >= time_ns] if len(rows) else rows
        return int(due_rows[0, TICK]) if len(due_rows) else None

    def rows(self, place: int, first: int, end: int) -> Rows:
        """Rows (n, columns) of the ticks from `first` to before `end` in chunk number `place`.

        An empty array without such ticks, for a damaged chunk, and if `place` is the number of chunks.
        """
        span = self.span(place) if place < self.end else None
        if span is None or span.last < first or span.first >= end:
            return np.empty((0, 0))
        rows = self._all_rows(place)
        begin, stop = np.searchsorted(rows[:, TICK], [first, end])
        return rows[begin:stop]

    def _all_rows(self, place: int) -> Rows:
        """Rows (n, columns) of chunk number `place`.

        Shape (0, 0) without ticks, for a damaged chunk, and if `place` is the number of chunks.
        """
        content = self.chunk(place) if place < self.end else None
        return content.rows if isinstance(content, Ticks) else np.empty((0, 0))

    def _read_chunk(self, place: int) -> Ticks | list[Message] | None:
        """Ticks or messages of chunk number `place`; None if it is damaged. `damage` gets the faults of the chunk."""
        problem_count = len(self.reader.left_out)
        content = self.reader.chunk(self.reader.entries[place])
        if place not in self.damage:
            self.damage[place] = self.reader.left_out[problem_count:]
        return content

    def _read_span(self, place: int) -> ChunkSpan | None:
        """First and last tick of chunk number `place`, with deadlines; None if it holds no ticks or is damaged."""
        rows = self._all_rows(place)
        return (
            ChunkSpan(*(int(rows[row, TICK]) for row in (0, -1)), *rows[[0, -1], DEADLINE].tolist())
            if len(rows)
            else None
        )

    def _first_place(self, condition: Callable[[ChunkSpan], bool]) -> int:
        """Index of the first chunk whose span meets `condition`; the number of chunks if there is none.

        All later spans must meet it as well. Chunks without ticks, and damaged ones, are passed over.
        """
        low, high, first_place = 0, self.end, self.end
        while low < high:
            middle = (low + high) // 2
            place = next((candidate for candidate in range(middle, high) if self.span(candidate)), None)
            span = None if place is None else self.span(place)
            if place is None or span is None:
                high = middle
            elif condition(span):
                high, first_place = middle, place
            else:
                low = place + 1
        return first_place
