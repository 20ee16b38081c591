"""A recording around events: what is drained goes through a memory, and from there into the file, or is summed up.

The files account for all ticks up to the oldest that waits in the memory; a recorder that takes another one's place
finds the rest in the rings. While nothing can be written, what is worth keeping waits as long as there is room.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rtloop.engine.memory import SharedBlock
from rtloop.errors import OutputError
from rtloop.recording.capture.buffer import TickTime
from rtloop.recording.capture.pending import PendingEntry
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.recording.capture.run_files import Options
from rtloop.recording.capture.segment_buffer import SegmentBuffer, WriteBatch
from rtloop.recording.capture.session import Session
from rtloop.recording.file.event_window import EventWindow
from rtloop.recording.file.topics.events import FINISHED, RETENTION_BEGUN, recorder_event


class SelectiveSession(Session):
    """As a Session; `header` says around what."""

    def __init__(
        self,
        block: SharedBlock,
        path: Path,
        header: dict[str, Any],
        options: Options,
        names: RequesterNames | None = None,
    ) -> None:
        super().__init__(block, path, header, options, names)
        window, rate_hz = EventWindow.from_header(header), header["rate_hz"]
        assert window is not None
        # nobody knows how long the one before was to go on
        retain_until = -1 if options.sequence == 1 else self._predecessor_end.ticks + round(window.after_s * rate_hz)
        self._segments = SegmentBuffer(window, header["columns"], rate_hz, self.cursor, retain_until)

    def _on_snapshot(self, tick: int) -> None:
        self._write(self._buffer.rows_before(tick), self._pending.take_entries(before=tick))
        self._segments.begin_segment(tick)
        if self.failure and self._header["paced"]:
            self._resume(tick)
        self._write_decided()

    def _write_all(self) -> None:
        """An event or a snapshot waits for its tick, so that all of them come in the order of their ticks."""
        if count := len(self._buffer):
            self._write(count, self._pending.take_entries(before=self._buffer.end))

    def _write(self, count: int, entries: list[PendingEntry]) -> None:
        """Into the memory, and from there what is decided."""
        self._stamp_write()
        rows = self._buffer.first_rows(count).copy()
        for hit in self._segments.find_hits(entries, rows):
            event = recorder_event(RETENTION_BEGUN, *self._buffer.tick_time(hit.first), {"on": hit.condition})
            entries.append(self._pending.make_entry(event))
        entries.sort(key=lambda entry: entry.message.log_time)
        self._segments.add(entries, rows)
        self._buffer.drop(count)
        self._write_decided()

    def _write_remaining(self, result: str) -> None:
        super()._write_remaining(result)
        self._write(0, self._pending.take_entries())
        if result != FINISHED:
            self._segments.retain_all()
        self._write_decided(decide_all=True)

    def _write_decided(self, *, decide_all: bool = False) -> None:
        while (
            self.failure is None
            and (batch := self._segments.next_batch(self._is_file_due, decide_all=decide_all)) is not None
        ):
            try:
                self._write_batch(batch)
            except OutputError as error:
                self._segments.requeue(batch)
                self._fail(error)
        if self.failure:
            self._pending.count_dropped(self._segments.drop_excess())

    def _write_batch(self, batch: WriteBatch) -> None:
        if batch.cut is not None:
            self._rotate(batch.cut)
        else:
            self._write_to_file(batch.rows, batch.entries, batch.intervals if len(batch.intervals) else None)

    def _begin_after_failure(self, tick: int) -> int:
        self._segments.begin_file()
        return self._segments.first_waiting_tick

    def _finish_file(self, kind: str, result: str, end_tick: int, event_tick: int) -> None:
        """Finish the file; ticks that wait go into the next one, so `event_tick` is `end_tick` at most."""
        super()._finish_file(kind, result, end_tick, min(end_tick, event_tick))

    def _waiting_count(self, channel: int) -> int:
        return super()._waiting_count(channel) + self._segments.waiting_count(channel)

    def _tick_time(self, tick: int) -> TickTime:
        """What was handed on is known exactly; what waits is behind it."""
        return self._files.end_place if tick == self._files.end_place.tick else super()._tick_time(tick)

    def _failure_time(self) -> TickTime:
        """Behind all events that wait."""
        return self._buffer.tick_time(self.cursor)
