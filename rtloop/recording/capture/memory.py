"""Ticks of which it is not yet known whether they are kept: a bounded memory, in segments from snapshot to snapshot.

A segment of which any tick lies within `before_s` in front of an event or `after_s` behind one is kept, every other one
is left out and summed up. Segments are decided, and handed out, in their order. The first one of a file is always kept.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from rtloop.recording.capture.conditions import Conditions, Hit
from rtloop.recording.capture.decimation import Decimation
from rtloop.recording.capture.pending import KEPT_EVENTS, Entry, waiting
from rtloop.recording.file.around import BATCH_S, SNAPSHOT_S, Around
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.overview import Intervals
from rtloop.signals import TICK

MOST_BYTES = 512 << 20
"""Of ticks that wait while nothing can be written, beside those that wait in any case."""
MOST_INTERVALS = 36_000
Rows = np.ndarray[Any, Any]


class Part(NamedTuple):
    """Ticks as they were drained, and the messages in front of them."""

    entries: list[Entry]
    rows: Rows


class Batch(NamedTuple):
    """What is to be written next: ticks that are kept, or the intervals of those that are left out.

    `cut` is set where, before anything else, a file is to begin at that tick.
    """

    entries: list[Entry]
    rows: Rows
    intervals: Intervals
    cut: int | None = None


@dataclass
class Segment:
    """From the snapshot at `begin` to before the one at `end`; None while that has not come."""

    begin: int
    kept: bool
    end: int | None = None
    parts: deque[Part] = field(default_factory=deque)
    asked: bool = False
    """Whether a file may not begin with it any more."""


class Memory:
    """Of a recorder that begins at tick `begin`; it keeps what follows to `keep_until`, whatever happens there."""

    def __init__(self, around: Around, columns: list[str], rate_hz: float, begin: int, keep_until: int) -> None:
        self._conditions = Conditions(around.on, columns)
        self._before, self._after = round(around.before_s * rate_hz), round(around.after_s * rate_hz)
        self._batch = round(max(around.every_s, BATCH_S) * rate_hz)
        self._decimation = Decimation(len(columns), max(round(around.every_s * rate_hz), 1))
        self._left: list[Entry] = []
        self._left_ticks = 0
        self._segments = deque([Segment(begin, kept=True, asked=True)])
        self._until, self._newest = keep_until, begin - 1
        self._none = np.empty((0, len(columns))), np.empty((0, len(columns), 3))
        usual_ticks = self._before + round(2 * SNAPSHOT_S * rate_hz)
        self._most = usual_ticks + min(self._after, MOST_BYTES // (8 * len(columns)))

    @property
    def begin(self) -> int:
        """The first tick that waits, or is expected next."""
        if not self._decimation.empty:
            return self._decimation.first
        return next((int(part.rows[0, TICK]) for part in self._parts() if len(part.rows)), self._newest + 1)

    def waiting(self, channel: int) -> int:
        """Messages of a topic that wait; of events those of the loop."""
        return sum(waiting(entries, channel) for entries in self._lists())

    def find(self, entries: list[Entry], rows: Rows) -> list[Hit]:
        """What makes new ticks, and those that wait, worth keeping; those of it that begin a stretch are returned."""
        events = [(entry.tick, kind) for entry in entries if (kind := _kind(entry))]
        new_hits = []
        for hit in self._conditions.find(rows, events):
            if hit.first > self._until:
                new_hits.append(hit)
            self._until = max(self._until, hit.last + self._after)
            for segment in self._segments:
                segment.kept = segment.kept or segment.end is None or segment.end > hit.first - self._before
        return new_hits

    def add(self, entries: list[Entry], rows: Rows) -> None:
        """What follows in the present segment."""
        self._segments[-1].parts.append(Part(entries, rows))
        if len(rows):
            self._newest = int(rows[-1, TICK])

    def cut(self, tick: int) -> None:
        """A segment ends before the snapshot of `tick`, another one begins with it."""
        if tick == self._segments[-1].begin:
            return
        self._segments[-1].end = tick
        self._segments.append(Segment(tick, kept=tick <= self._until))

    def begin_file(self) -> None:
        """The next segment is the first one of a file."""
        self._segments[0].kept = self._segments[0].asked = True

    def keep_all(self) -> None:
        """Whatever waits is worth keeping."""
        for segment in self._segments:
            segment.kept = True

    def next(self, file_is_due: Callable[[int], bool], *, end: bool = False) -> Batch | None:
        """What is decided, in order; `end` decides everything. `file_is_due(tick)`: whether one is to begin there."""
        while self._segments:
            head = self._segments[0]
            is_decided = end or (head.end is not None and head.end <= self._newest - self._before)
            if not (head.kept or is_decided):
                break
            if not head.asked and any(len(batch.rows) for batch in head.parts):
                head.asked, due = True, file_is_due(head.begin)
                if due:
                    head.kept = True
                    if not self._left_empty:
                        head.asked = False
                        return self._left_out()
                    return Batch([], *self._none, cut=head.begin)
            if head.kept and not self._left_empty:
                return self._left_out()
            if head.parts:
                batch = head.parts.popleft()
                if head.kept:
                    return Batch(batch.entries, batch.rows, self._none[1])
                self._leave_out(batch)
            elif head.end is None and not end:
                return None
            else:
                self._segments.popleft()
        return self._left_out() if not self._left_empty and (end or self._left_ticks >= self._batch) else None

    def put_back(self, batch: Batch) -> None:
        """It could not be written."""
        if len(batch.intervals):
            self._decimation.put_back(batch.intervals)
            self._left, self._left_ticks = batch.entries + self._left, self._batch
        elif batch.cut is None:
            if not self._segments:
                self._segments.append(Segment(self._newest + 1, kept=True, asked=True))
            self._segments[0].parts.appendleft(Part(batch.entries, batch.rows))

    def make_room(self) -> list[Entry]:
        """Have no more wait than there is room for while nothing can be written; events for which there is none.

        What is worth keeping is given up last.
        """
        while sum(len(batch.rows) for batch in self._parts()) > self._most:
            complete_segments = [
                candidate for candidate in self._segments if candidate.parts and candidate.end is not None
            ]
            if not complete_segments:
                break
            segment = next((candidate for candidate in complete_segments if not candidate.kept), complete_segments[0])
            batch = segment.parts.popleft()
            if segment is complete_segments[0] and not segment.kept and self._decimation.pending < MOST_INTERVALS:
                self._leave_out(batch)
            else:
                next_batch = next(
                    candidate.parts[0]
                    for candidate in self._segments
                    if candidate.begin >= segment.begin and candidate.parts
                )
                next_batch.entries[:0] = [entry for entry in batch.entries if entry.message.channel == format.EVENTS]
        events = [(entries, entry) for entries in self._lists() for entry in entries if entry.of_loop]
        for entries, entry in events[KEPT_EVENTS:]:
            entries.remove(entry)
        return [entry for _, entry in events[KEPT_EVENTS:]]

    def _lists(self) -> list[list[Entry]]:
        return [self._left, *(part.entries for part in self._parts())]

    def _parts(self) -> list[Part]:
        return [part for segment in self._segments for part in segment.parts]

    @property
    def _left_empty(self) -> bool:
        return self._decimation.empty and not self._left

    def _leave_out(self, part: Part) -> None:
        self._left += [entry for entry in part.entries if entry.message.channel == format.EVENTS]
        self._decimation.add(part.rows)
        self._left_ticks += len(part.rows)

    def _left_out(self) -> Batch:
        entries, self._left, self._left_ticks = self._left, [], 0
        return Batch(entries, self._none[0], self._decimation.close())


def _kind(entry: Entry) -> str | None:
    """Of an event of the loop's; None for anything else."""
    return json.loads(entry.message.payload)["kind"] if entry.of_loop else None
