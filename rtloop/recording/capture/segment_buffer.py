"""Bounded memory of ticks that are not yet known to be worth recording, in segments from snapshot to snapshot.

A segment is retained if any of its ticks lies within `before_s` before an event or `after_s` after one; an overview
replaces every other segment. Segments are decided and released by ascending ticks. The first segment of a file is
always retained.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.recording.capture.conditions import Conditions, Hit
from rtloop.recording.capture.decimation import Decimation
from rtloop.recording.capture.pending import MAX_PENDING_EVENTS, PendingEntry, count_pending
from rtloop.recording.file.event_window import OVERVIEW_BATCH_S, SNAPSHOT_S, EventWindow
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.overview import Intervals, most_intervals
from rtloop.signals import TICK

MAX_WAITING_BYTES = 512 << 20
"""Maximum size of the rows stored while no file can be written, besides the rows that always wait."""
MAX_WAITING_INTERVALS = 36_000


class DrainedBatch(NamedTuple):
    """Drained ticks and the messages that precede them."""

    entries: list[PendingEntry]
    rows: Real


class WriteBatch(NamedTuple):
    """Data to write next: retained ticks, `rows` (n, columns), or `intervals` (n, columns, 3) of omitted ticks.

    If `cut` is a tick, the batch is empty and the next file must begin at that tick.
    """

    entries: list[PendingEntry]
    rows: Real
    intervals: Intervals
    cut: int | None = None


@dataclass
class Segment:
    """Ticks from the snapshot at `begin` to before the snapshot at `end`; `end` is None until that is known.

    `retain`: the ticks go into a file; otherwise an overview replaces them once the segment is decided.
    """

    begin: int
    retain: bool
    end: int | None = None
    batches: deque[DrainedBatch] = field(default_factory=deque)
    file_decided: bool = False
    """Whether it is decided that a file begins with this segment or not."""


class SegmentBuffer:
    """Segments from tick `begin` on; the buffer retains all ticks up to `retain_until`, with or without an event."""

    def __init__(self, window: EventWindow, columns: list[str], rate_hz: float, begin: int, retain_until: int) -> None:
        """Begin with a segment at tick `begin`, which is retained, as are all ticks ≤ `retain_until` (−1: none).

        `window` has the conditions and the times to retain, `columns` the names of the signals. Raises ValueError for a
        condition that does not fit `columns`.
        """
        self._conditions = Conditions(window.on, columns)
        self._ticks_before, self._ticks_after = round(window.before_s * rate_hz), round(window.after_s * rate_hz)
        self._overview_ticks = round(max(window.every_s, OVERVIEW_BATCH_S) * rate_hz)
        self._decimation = Decimation(len(columns), max(round(window.every_s * rate_hz), 1))
        self._most_intervals = most_intervals(len(columns))
        self._skipped_entries: list[PendingEntry] = []
        self._skipped_ticks = 0
        self._segments = deque([Segment(begin, retain=True, file_decided=True)])
        self._retain_until, self._newest_tick = retain_until, begin - 1
        self._empty_arrays = np.empty((0, len(columns))), np.empty((0, len(columns), 3))
        usual_ticks = self._ticks_before + round(2 * SNAPSHOT_S * rate_hz)
        self._max_waiting_ticks = usual_ticks + min(self._ticks_after, MAX_WAITING_BYTES // (8 * len(columns)))

    @property
    def first_waiting_tick(self) -> int:
        """First tick that is neither written nor dropped; the tick after the newest one if none waits."""
        if self._decimation.pending_count:
            return self._decimation.first_tick
        return next((int(part.rows[0, TICK]) for part in self._batches() if len(part.rows)), self._newest_tick + 1)

    def count_pending(self, channel: int) -> int:
        """Count the waiting messages with channel id `channel`, without events that the recorder itself made."""
        return sum(count_pending(entries, channel) for entries in self._entry_lists())

    def find_hits(self, entries: list[PendingEntry], rows: Real) -> list[Hit]:
        """Mark segments to retain, and extend the retained span, by the conditions that hold in `entries` and `rows`.

        `entries` and `rows` are new and not yet added. Returns the hits that begin a retained span of ticks.
        """
        events = [(entry.tick, kind) for entry in entries if (kind := _event_kind(entry))]
        new_hits = []
        for hit in self._conditions.find_hits(rows, events):
            if hit.first > self._retain_until:
                new_hits.append(hit)
            self._retain_until = max(self._retain_until, hit.last + self._ticks_after)
            for segment in self._segments:
                segment.retain = segment.retain or segment.end is None or segment.end > hit.first - self._ticks_before
        return new_hits

    def add(self, entries: list[PendingEntry], rows: Real) -> None:
        """Append messages and ticks to the present segment, without a copy of `entries` and `rows`."""
        self._segments[-1].batches.append(DrainedBatch(entries, rows))
        if len(rows):
            self._newest_tick = int(rows[-1, TICK])

    def begin_segment(self, tick: int) -> None:
        """End the present segment before the snapshot of `tick` and begin the next one with it.

        The next one is retained if the retained span reaches it. If the present one begins at `tick`, do nothing.
        """
        if tick == self._segments[-1].begin:
            return
        self._segments[-1].end = tick
        self._segments.append(Segment(tick, retain=tick <= self._retain_until))

    def begin_file(self) -> None:
        """Make the oldest segment the first of a file, so that it is retained."""
        self._segments[0].retain = self._segments[0].file_decided = True

    def retain_all(self) -> None:
        """Retain all waiting segments."""
        for segment in self._segments:
            segment.retain = True

    def next_batch(self, file_is_due: Callable[[int], bool], *, decide_all: bool = False) -> WriteBatch | None:
        """Remove and return the oldest batch of data that is ready to be written; None if none is ready.

        The batch is retained ticks, an overview, or a cut: `file_is_due(tick)` tells whether a file should begin at the
        snapshot of `tick`. Ticks that a later event may still retain are not ready, nor is an overview that is shorter
        than OVERVIEW_BATCH_S or one interval and that no retained ticks follow; `decide_all` returns both as well.
        """
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
        """Put back a batch that could not be written, as the first one; ignore a batch that is a cut."""
        if len(batch.intervals):
            self._decimation.requeue(batch.intervals)
            self._skipped_entries, self._skipped_ticks = batch.entries + self._skipped_entries, self._overview_ticks
        elif batch.cut is None:
            if not self._segments:
                self._segments.append(Segment(self._newest_tick + 1, retain=True, file_decided=True))
            self._segments[0].batches.appendleft(DrainedBatch(batch.entries, batch.rows))

    def drop_excess(self) -> list[PendingEntry]:
        """Drop ticks of complete segments, retained ones last, and the loop's newest events, until the limits hold.

        Ticks of the oldest segment, if it is not retained, become an overview instead while there is room. Returns the
        dropped events.
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
        """Return the lists in which messages wait (no copies), in the order of their ticks: omitted ticks first."""
        return [self._skipped_entries, *(part.entries for part in self._batches())]

    def _batches(self) -> list[DrainedBatch]:
        """All waiting batches, in the order of their ticks."""
        return [part for segment in self._segments for part in segment.batches]

    @property
    def _skipped_is_empty(self) -> bool:
        """Whether neither an omitted tick nor an event of an omitted tick waits to be written."""
        return not (self._decimation.pending_count or self._skipped_entries)

    def _skip(self, batch: DrainedBatch) -> None:
        """Reduce the ticks of a batch to an overview and keep its events; its snapshots are discarded."""
        self._skipped_entries += [entry for entry in batch.entries if entry.message.channel == format.EVENTS]
        self._decimation.add_rows(batch.rows)
        self._skipped_ticks += len(batch.rows)

    def _take_skipped(self) -> WriteBatch:
        """Remove and return minimum, maximum and mean per interval of the omitted ticks, with the ticks' events.

        What does not fit into one chunk waits for the next call.
        """
        entries, self._skipped_entries = self._skipped_entries, []
        intervals = self._decimation.take_intervals(self._most_intervals)
        if not self._decimation.pending_count:
            self._skipped_ticks = 0
        return WriteBatch(entries, self._empty_arrays[0], intervals)


def _event_kind(entry: PendingEntry) -> str | None:
    """Kind of an event of the loop, such as "tripped"; None for any other message."""
    return json.loads(entry.message.payload)["kind"] if entry.from_loop else None
