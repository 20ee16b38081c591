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
from rtloop.recording.capture.pending import MAX_PENDING_EVENTS, PendingEntry, count_waiting
from rtloop.recording.file.event_window import OVERVIEW_BATCH_S, SNAPSHOT_S, EventWindow
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.overview import Intervals
from rtloop.signals import TICK

MAX_WAITING_BYTES = 512 << 20
"""Of ticks that wait while nothing can be written, beside those that wait in any case."""
MAX_WAITING_INTERVALS = 36_000
Rows = np.ndarray[Any, Any]


class DrainedBatch(NamedTuple):
    """Ticks as they were drained, and the messages in front of them."""

    entries: list[PendingEntry]
    rows: Rows


class WriteBatch(NamedTuple):
    """What is to be written next: ticks that are kept, or the intervals of those that are left out.

    `cut` is set where, before anything else, a file is to begin at that tick.
    """

    entries: list[PendingEntry]
    rows: Rows
    intervals: Intervals
    cut: int | None = None


@dataclass
class Segment:
    """From the snapshot at `begin` to before the one at `end`; None while that has not come."""

    begin: int
    retain: bool
    end: int | None = None
    batches: deque[DrainedBatch] = field(default_factory=deque)
    file_decided: bool = False
    """Whether a file may not begin with it any more."""


class SegmentBuffer:
    """Segments of a recorder that begins at tick `begin`; it retains all ticks up to `retain_until`, event or not."""

    def __init__(self, window: EventWindow, columns: list[str], rate_hz: float, begin: int, retain_until: int) -> None:
        self._conditions = Conditions(window.on, columns)
        self._ticks_before, self._ticks_after = round(window.before_s * rate_hz), round(window.after_s * rate_hz)
        self._overview_ticks = round(max(window.every_s, OVERVIEW_BATCH_S) * rate_hz)
        self._decimation = Decimation(len(columns), max(round(window.every_s * rate_hz), 1))
        self._skipped_entries: list[PendingEntry] = []
        self._skipped_ticks = 0
        self._segments = deque([Segment(begin, retain=True, file_decided=True)])
        self._retain_until, self._newest_tick = retain_until, begin - 1
        self._empty_arrays = np.empty((0, len(columns))), np.empty((0, len(columns), 3))
        usual_ticks = self._ticks_before + round(2 * SNAPSHOT_S * rate_hz)
        self._max_waiting_ticks = usual_ticks + min(self._ticks_after, MAX_WAITING_BYTES // (8 * len(columns)))

    @property
    def first_waiting_tick(self) -> int:
        """The first tick that waits, or is expected next."""
        if not self._decimation.is_empty:
            return self._decimation.first_tick
        return next((int(part.rows[0, TICK]) for part in self._batches() if len(part.rows)), self._newest_tick + 1)

    def waiting_count(self, channel: int) -> int:
        """Messages of a topic that wait; of events those of the loop."""
        return sum(count_waiting(entries, channel) for entries in self._entry_lists())

    def find_hits(self, entries: list[PendingEntry], rows: Rows) -> list[Hit]:
        """What makes new ticks, and those that wait, worth keeping; those of it that begin a stretch are returned."""
        events = [(entry.tick, kind) for entry in entries if (kind := _event_kind(entry))]
        new_hits = []
        for hit in self._conditions.find_hits(rows, events):
            if hit.first > self._retain_until:
                new_hits.append(hit)
            self._retain_until = max(self._retain_until, hit.last + self._ticks_after)
            for segment in self._segments:
                segment.retain = segment.retain or segment.end is None or segment.end > hit.first - self._ticks_before
        return new_hits

    def add(self, entries: list[PendingEntry], rows: Rows) -> None:
        """What follows in the present segment."""
        self._segments[-1].batches.append(DrainedBatch(entries, rows))
        if len(rows):
            self._newest_tick = int(rows[-1, TICK])

    def begin_segment(self, tick: int) -> None:
        """A segment ends before the snapshot of `tick`, another one begins with it."""
        if tick == self._segments[-1].begin:
            return
        self._segments[-1].end = tick
        self._segments.append(Segment(tick, retain=tick <= self._retain_until))

    def begin_file(self) -> None:
        """The next segment is the first one of a file."""
        self._segments[0].retain = self._segments[0].file_decided = True

    def retain_all(self) -> None:
        """Whatever waits is worth keeping."""
        for segment in self._segments:
            segment.retain = True

    def next_batch(self, file_is_due: Callable[[int], bool], *, decide_all: bool = False) -> WriteBatch | None:
        """What is decided, in order; `end` decides everything. `file_is_due(tick)`: whether one is to begin there."""
        while self._segments:
            head = self._segments[0]
            is_decided = decide_all or (head.end is not None and head.end <= self._newest_tick - self._ticks_before)
            if not (head.retain or is_decided):
                break
            if not head.file_decided and any(len(batch.rows) for batch in head.batches):
                head.file_decided, due = True, file_is_due(head.begin)
                if due:
                    head.retain = True
                    if not self._skipped_is_empty:
                        head.file_decided = False
                        return self._take_skipped()
                    return WriteBatch([], *self._empty_arrays, cut=head.begin)
            if head.retain and not self._skipped_is_empty:
                return self._take_skipped()
            if head.batches:
                batch = head.batches.popleft()
                if head.retain:
                    return WriteBatch(batch.entries, batch.rows, self._empty_arrays[1])
                self._skip(batch)
            elif head.end is None and not decide_all:
                return None
            else:
                self._segments.popleft()
        return (
            self._take_skipped()
            if not self._skipped_is_empty and (decide_all or self._skipped_ticks >= self._overview_ticks)
            else None
        )

    def requeue(self, batch: WriteBatch) -> None:
        """It could not be written."""
        if len(batch.intervals):
            self._decimation.requeue(batch.intervals)
            self._skipped_entries, self._skipped_ticks = batch.entries + self._skipped_entries, self._overview_ticks
        elif batch.cut is None:
            if not self._segments:
                self._segments.append(Segment(self._newest_tick + 1, retain=True, file_decided=True))
            self._segments[0].batches.appendleft(DrainedBatch(batch.entries, batch.rows))

    def drop_excess(self) -> list[PendingEntry]:
        """Have no more wait than there is room for while nothing can be written; events for which there is none.

        What is worth keeping is given up last.
        """
        while sum(len(batch.rows) for batch in self._batches()) > self._max_waiting_ticks:
            complete_segments = [
                candidate for candidate in self._segments if candidate.batches and candidate.end is not None
            ]
            if not complete_segments:
                break
            segment = next((candidate for candidate in complete_segments if not candidate.retain), complete_segments[0])
            batch = segment.batches.popleft()
            if (
                segment is complete_segments[0]
                and not segment.retain
                and self._decimation.pending_count < MAX_WAITING_INTERVALS
            ):
                self._skip(batch)
            else:
                next_batch = next(
                    candidate.batches[0]
                    for candidate in self._segments
                    if candidate.begin >= segment.begin and candidate.batches
                )
                next_batch.entries[:0] = [entry for entry in batch.entries if entry.message.channel == format.EVENTS]
        events = [(entries, entry) for entries in self._entry_lists() for entry in entries if entry.from_loop]
        for entries, entry in events[MAX_PENDING_EVENTS:]:
            entries.remove(entry)
        return [entry for _, entry in events[MAX_PENDING_EVENTS:]]

    def _entry_lists(self) -> list[list[PendingEntry]]:
        return [self._skipped_entries, *(part.entries for part in self._batches())]

    def _batches(self) -> list[DrainedBatch]:
        return [part for segment in self._segments for part in segment.batches]

    @property
    def _skipped_is_empty(self) -> bool:
        return self._decimation.is_empty and not self._skipped_entries

    def _skip(self, batch: DrainedBatch) -> None:
        self._skipped_entries += [entry for entry in batch.entries if entry.message.channel == format.EVENTS]
        self._decimation.add_rows(batch.rows)
        self._skipped_ticks += len(batch.rows)

    def _take_skipped(self) -> WriteBatch:
        entries, self._skipped_entries, self._skipped_ticks = self._skipped_entries, [], 0
        return WriteBatch(entries, self._empty_arrays[0], self._decimation.take_intervals())


def _event_kind(entry: PendingEntry) -> str | None:
    """Of an event of the loop's; None for anything else."""
    return json.loads(entry.message.payload)["kind"] if entry.from_loop else None
