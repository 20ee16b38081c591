"""Where a tick is in a file, without reading all of it: by halving, a chunk is opened only where it is looked at."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from rtloop.recording.file.reader import Reader, Rows
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.events import FINAL
from rtloop.recording.file.topics.format import EVENTS
from rtloop.recording.file.topics.ticks import Ticks
from rtloop.signals import DEADLINE, TICK

CACHED_SPANS = 1 << 14


class ChunkSpan(NamedTuple):
    """The ticks of a chunk, and when the first and the last of them were due, in ns since the start."""

    first: int
    last: int
    first_ns: float
    last_ns: float


class ChunkSeeker:
    """Places of chunks in an open file. What is damaged is passed over, and named in the reader's problems."""

    def __init__(self, reader: Reader) -> None:
        self.reader = reader
        self.span = lru_cache(CACHED_SPANS)(self._read_span)
        self.chunk = lru_cache(2)(self._read_chunk)
        self.damage: dict[int, list[str]] = {}
        """What is wrong with a chunk that was looked at, by its place."""

    @property
    def end(self) -> int:
        """The place behind the last chunk."""
        return len(self.reader.entries)

    def first_span(self) -> ChunkSpan | None:
        """The first chunk with ticks."""
        return next(filter(None, map(self.span, range(self.end))), None)

    def last_span(self) -> ChunkSpan | None:
        """The last chunk with ticks."""
        return next(filter(None, map(self.span, reversed(range(self.end)))), None)

    def final_totals(self) -> dict[str, Any] | None:
        """What was counted at the end of the file; None where it was not finished."""
        content = self.chunk(self.end - 1)
        events = (
            [json.loads(message.payload) for message in content if message.channel == EVENTS]
            if isinstance(content, list)
            else []
        )
        return next((event["what"] for event in reversed(events) if event["kind"] in FINAL), None)

    def find_place(self, tick: int) -> int:
        """Place of the first chunk that has `tick` or a later one; `end` where none has."""
        return self._first_place(lambda span: span.last >= tick)

    def has_tick(self, tick: int) -> bool:
        """Whether a tick is there."""
        return len(self.rows(self.find_place(tick), tick, tick + 1)) > 0

    def first_tick_due(self, time_ns: float) -> int | None:
        """The first tick that was due at `time_ns` since the start, or later; None where all were due before."""
        place = self._first_place(lambda span: span.last_ns >= time_ns)
        rows = self._all_rows(place)
        due_rows = rows[rows[:, DEADLINE] >= time_ns] if len(rows) else rows
        return int(due_rows[0, TICK]) if len(due_rows) else None

    def rows(self, place: int, first: int, end: int) -> Rows:
        """The ticks from `first` to before `end` (n, columns) of the chunk at a place; (0, 0) where it holds none."""
        span = self.span(place) if place < self.end else None
        if span is None or span.last < first or span.first >= end:
            return np.empty((0, 0))
        rows = self._all_rows(place)
        begin, stop = np.searchsorted(rows[:, TICK], [first, end])
        return rows[begin:stop]

    def _all_rows(self, place: int) -> Rows:
        content = self.chunk(place) if place < self.end else None
        return content.rows if isinstance(content, Ticks) else np.empty((0, 0))

    def _read_chunk(self, place: int) -> Ticks | list[Message] | None:
        """What the chunk at a place holds; None where it is damaged."""
        problem_count = len(self.reader.left_out)
        content = self.reader.chunk(self.reader.entries[place])
        if place not in self.damage:
            self.damage[place] = self.reader.left_out[problem_count:]
        return content

    def _read_span(self, place: int) -> ChunkSpan | None:
        """Of the chunk at a place; None where it holds no ticks."""
        rows = self._all_rows(place)
        return (
            ChunkSpan(*(int(rows[row, TICK]) for row in (0, -1)), *rows[[0, -1], DEADLINE].tolist())
            if len(rows)
            else None
        )

    def _first_place(self, condition: Callable[[ChunkSpan], bool]) -> int:
        """The first place whose span meets a condition that all behind it meet as well."""
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
