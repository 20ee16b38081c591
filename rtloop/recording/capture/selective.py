"""Session of a recording around events: drained ticks wait in a buffer until they are written or reduced.

The files account for all ticks up to the oldest tick in the buffer; a replacement recorder finds the later ones in
the rings. While no file can be written, ticks worth recording wait as long as the buffer has room.
"""

from __future__ import annotations

from pathlib import Path

from rtloop.engine.memory import SharedBlock
from rtloop.errors import OutputError
from rtloop.foundation import timing
from rtloop.recording.capture.buffer import TickTime
from rtloop.recording.capture.pending import PendingEntry
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.recording.capture.run_files import Options
from rtloop.recording.capture.segment_buffer import SegmentBuffer, WriteBatch
from rtloop.recording.capture.session import Session
from rtloop.recording.file.event_window import EventWindow
from rtloop.recording.file.topics.events import FINISHED, RETENTION_BEGUN, recorder_event
from rtloop.recording.file.topics.format import Header


class SelectiveSession(Session):
    """Session that writes every tick near an event and an overview of the others, as `around` of the header says."""

    def __init__(
        self,
        block: SharedBlock,
        path: Path,
        header: Header,
        options: Options,
        names: RequesterNames | None = None,
    ) -> None:
        """Open the first file and begin to read the rings as `Session` does, and make the buffer of segments.

        Raises OutputError as `Session` does; ValueError, with the first file open, if `header` has no `around`.
        """
        super().__init__(block, path, header, options, names)
        window, rate_hz = EventWindow.from_header(header), header["rate_hz"]
        if window is None:
            raise ValueError(
                f"{path}: the header of the recording has no entry 'around'; a recording around events needs this entry"
            )
        # A dead recorder may have been retaining ticks, and its end of that is unknown.
        retain_until = -1 if options.sequence == 1 else self._predecessor_end.ticks + round(window.after_s * rate_hz)
        self._segments = SegmentBuffer(window, header["columns"], rate_hz, self.cursor, retain_until)

    def _handle_snapshot(self, tick: int) -> None:
        """Move the ticks and messages before the snapshot of `tick` to the segments; begin a segment at `tick`.

        Then, if a failure stopped a paced recording, try to resume in a new file. Finally write the segments that are
        decided: retained ones, and overviews in place of the others.
        """
        self._write(self._buffer.count_before(tick), self._pending.take_entries(before=tick))
        self._segments.begin_segment(tick)
        if self.failure and self._header["paced"]:
            self._resume(tick)
        self._write_decided()

    def _write_all(self) -> None:
        """Move all drained ticks, and the messages up to the last of them, to the segments; write decided segments.

        Later messages wait for their ticks.
        """
        if count := len(self._buffer):
            self._write(count, self._pending.take_entries(before=self._buffer.end))

    def _write(self, count: int, entries: list[PendingEntry]) -> None:
        """Move the first `count` rows and `entries` to the segments, then write the decided batches.

        A condition that begins a retained span adds an event RETENTION_BEGUN.
        """
        self._last_write_s = timing.monotonic_s()
        rows = self._buffer.rows[:count].copy()
        for hit in self._segments.find_hits(entries, rows):
            event = recorder_event(RETENTION_BEGUN, *self._buffer.tick_time(hit.first), {"on": hit.condition})
            entries.append(self._pending.make_entry(event))
        entries.sort(key=lambda entry: entry.message.log_time)
        self._segments.add(entries, rows)
        self._buffer.drop(count)
        self._write_decided()

    def _write_remaining(self, result: str) -> None:
        """Write all waiting ticks and messages.

        If `result` is "finished", overviews replace ticks far from events; after any other end all are retained.
        """
        super()._write_remaining(result)
        self._write(0, self._pending.take_entries())
        if result != FINISHED:
            self._segments.retain_all()
        self._write_decided(decide_all=True)

    def _write_decided(self, *, decide_all: bool = False) -> None:
        """Write the batches of decided segments (retained, or replaced by an overview); `decide_all` decides all.

        A batch whose write fails is put back, and recording stops. While no file can be written, drop data beyond the
        limits of the segments.
        """
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
        """Write a batch, or begin the next file if `batch.cut` gives its first tick.

        Raises OutputError if the write fails; a file that cannot be begun stops recording instead.
        """
        if batch.cut is not None:
            self._rotate(batch.cut)
        else:
            self._write_to_file(batch.rows, batch.entries, batch.intervals if len(batch.intervals) else None)

    def _begin_after_failure(self, tick: int) -> int:
        """Retain the oldest segment. Returns the first waiting tick, at which the new file begins."""
        self._segments.begin_file()
        return self._segments.first_waiting_tick

    def _finish_file(self, kind: str, result: str, end_tick: int, event_tick: int) -> None:
        """Finish the file as `Session` does, with its last event at `event_tick`, but not after `end_tick`.

        `kind` of that event is FINISHED or ROTATED; `result` tells how the loop ended, "rotated" for ROTATED. Ticks
        that still wait, from `end_tick` on, go into the next file. An error of the file sets `error`; none is raised.
        """
        super()._finish_file(kind, result, end_tick, min(end_tick, event_tick))

    def _count_pending(self, channel: int) -> int:
        """Count the waiting messages with channel id `channel`, in the queue and in the segments.

        Events that the recorder itself made do not count.
        """
        return super()._count_pending(channel) + self._segments.count_pending(channel)

    def _tick_time(self, tick: int) -> TickTime:
        """Return `tick` with its deadline: exact at the end of the written ticks, else as `TickBuffer.tick_time`."""
        return self._files.end_place if tick == self._files.end_place.tick else super()._tick_time(tick)

    def _failure_time(self) -> TickTime:
        """Tick and deadline of the event of a failed write: the next tick to drain, after all waiting events."""
        return self._buffer.tick_time(self.cursor)
