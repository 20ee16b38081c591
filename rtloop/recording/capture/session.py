"""Session of a recorder: drains the rings of one run and writes its file or files.

Ticks are drained before snapshots, snapshots before events, and ticks are written last. The snapshot and the commands
that precede a tick therefore always stand before it in the file. A snapshot waits until all earlier ticks were
drained, so that a file can be cut at it, however far the loop is ahead.
"""

from __future__ import annotations

import errno
import math
from collections import deque
from collections.abc import Mapping
from pathlib import Path

from rtloop.engine.memory import SharedBlock, Word
from rtloop.errors import OutputError
from rtloop.foundation import timing
from rtloop.foundation.arrays import Real
from rtloop.recording.capture.buffer import TickBuffer, TickSpans, TickTime
from rtloop.recording.capture.pending import PendingEntry, PendingMessages, snapshot_tick
from rtloop.recording.capture.progress import RecorderProgress, RingPosition
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.recording.capture.rings import RingReader
from rtloop.recording.capture.run_files import Options, RunFiles, predecessor_file
from rtloop.recording.capture.successor import snapshot_before
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.events import (
    FILE_REMOVED,
    FINISHED,
    GAP,
    RECORDING_FAILED,
    RECORDING_RESUMED,
    ROTATED,
    event_from_message,
    law_label,
    recorder_event,
)
from rtloop.recording.file.topics.overview import Intervals
from rtloop.signals import TICK

FLUSH_S = 0.4
"""Time after which drained ticks are written: the recorder's pause, so that at most half a second of ticks is not in
the file. It does not count in virtual time: the bytes of the file do not depend on the speed of the machine."""
UNPACED_CHUNKS = 8
"""Number of chunks that wait for each other in virtual time, so that all processors pack them at once."""
RESUME_FREE_BYTES = 1 << 20
"""Space that must be free, besides 5/4 of `min_free_bytes`, before a file is begun after a failure."""


class Session:
    """Session that drains the rings of a shared block and writes the files of one run.

    After a failed write it continues to drain, counts the loss, and tries a new file at every snapshot. `failure` is
    the present reason for not recording (None: it records), `error` the first one. An unpaced run is not resumed.
    """

    def __init__(
        self,
        block: SharedBlock,
        path: Path,
        header: format.Header,
        options: Options,
        names: RequesterNames | None = None,
    ) -> None:
        """Open the first file, with `header`, of the run recorded as `path`, and begin to read the rings of `block`.

        `names` gives the operators' names for events. With `options.sequence` above 1, the session replaces a dead
        recorder: it begins at a snapshot that the dead recorder's file holds, if possible, and tries again at later
        snapshots if its file cannot be opened. Raises OutputError if the first file of the run cannot be opened.
        """
        self._names = names
        self._block, self._path, self._header, self._options = block, path, header, options
        self._laws = [law_label(law["name"], law.get("file", "")) for law in header.get("law", {}).get("laws", ())]
        self._buffer = TickBuffer(header["columns"], header["rate_hz"], self._buffer_chunks)
        self._last_write_s = timing.monotonic_s()
        self._progress = RecorderProgress(block)
        self._predecessor_end = self._progress.predecessor_position(predecessor_file(path, options.sequence))
        self._progress.store_flushed(self._predecessor_end)
        self._waiting_snapshots: deque[bytes] = deque()
        self._pending = PendingMessages(self._buffer, self._start_unix_ns)
        self.error: str | None = None
        self.failure: OutputError | None = None
        snapshot = snapshot_before(block, self._predecessor_end) if options.sequence > 1 else None
        self._read_from(snapshot or self._predecessor_end, repeats=snapshot is not None)
        try:
            self._files.switch(self._files.open_next(header["created_unix_ns"] if header["paced"] else 0))
        except OutputError as error:
            if options.sequence == 1:
                raise
            self._read_from(self._predecessor_end, repeats=False)
            self._fail(error)

    def _read_from(self, position: RingPosition, *, repeats: bool) -> None:
        """Make readers that begin at `position` of the rings, and prepare the files of the run from its tick on.

        No slot is read and no file opened yet. `repeats`: the ticks from `position` to the end of the dead recorder's
        file are written again.
        """
        self._ticks = RingReader(self._block, "ticks", position.ticks)
        self._snapshots = RingReader(self._block, "snapshots", position.snapshots)
        self._events = RingReader(self._block, "events", position.events)
        begin, end = (self._buffer.tick_time(tick) for tick in (position.ticks, self._predecessor_end.ticks))
        ticks_logged = position.ticks - position.lost
        self._files = RunFiles(self._path, self._header, self._options, begin, ticks_logged, end if repeats else None)
        self._cut_tick = position.ticks

    @property
    def _buffer_chunks(self) -> int:
        """Number of chunks of ticks to drain before a write: 1 in a paced run or around events, else UNPACED_CHUNKS."""
        return 1 if self._header["paced"] or self._header.get("around") else UNPACED_CHUNKS

    @property
    def cursor(self) -> int:
        """Number of the next tick to take from the ring; all ticks before it were taken or lost."""
        return self._ticks.position

    @property
    def free_rows(self) -> int:
        """Number of ticks that the next drain can take."""
        return self._buffer.free_rows

    def drain(self) -> int:
        """Copy the new ticks into the buffer and queue the new events and snapshots.

        A snapshot is handled once all ticks before it are drained, and a file may begin there. Returns the number of
        ticks (taken or lost), snapshots and events.
        """
        ticks = self._buffer.take_from(self._ticks)
        snapshots, events = self._snapshots.take(), self._events.take()
        for message in events:
            time_ns = self._buffer.tick_time(int(message["tick"])).time_ns
            name = self._names and self._names.requester(int(message["identity"]))
            self._pending.add_event(event_from_message(message, self._header["axes"], time_ns, self._laws, name))
        self._waiting_snapshots.extend(map(bytes, snapshots))
        while self._waiting_snapshots and (tick := snapshot_tick(self._waiting_snapshots[0])) <= self.cursor:
            self._handle_snapshot(tick)
            self._pending.add_snapshot(self._waiting_snapshots.popleft())
        return ticks + len(snapshots) + len(events)

    def record_removal(self, details: Mapping[str, object]) -> None:
        """Queue the event FILE_REMOVED: a file, of this run or an earlier one, was removed to make room.

        `details`: file (its name), size_bytes, reason.
        """
        self._pending.add_event(recorder_event(FILE_REMOVED, *self._buffer.tick_time(self.cursor), details))

    def write_due(self) -> None:
        """Write all drained data if the buffer is full or, in a paced run, FLUSH_S has passed since the last write.

        A failed write sets `failure` and does not raise.
        """
        is_late = self._header["paced"] and timing.monotonic_s() - self._last_write_s >= FLUSH_S
        if self.free_rows == 0 or is_late:
            self._write_all()

    def finish(self, result: str) -> dict[str, object]:
        """Write the remaining data and finish the file.

        `result`: how the loop ended, as `Recorder.record` returns it. Returns {path, paths, ticks_logged, ticks_lost,
        events_lost, bytes, complete, error}: `paths` are the finished files of this session that exist, `path` is the
        last of them or, without one, the path of the run, `bytes` the size of the files that this session finished or
        left unfinished, `error` the first failure or None. The counts of ticks include earlier recorders of the run.
        """
        self._write_remaining(result)
        self._pending.count_dropped(self._pending.take_entries())
        self._finish_file(FINISHED, result, self.cursor, self.cursor)
        if self._files.end_place.tick >= self._predecessor_end.ticks:  # Finishing the file may have dropped ticks.
            self._store_progress(self._files.end_place.tick)
        paths = [str(path) for path in self._files.paths]
        lost = self.cursor - self._files.ticks_logged - self._files.ticks_skipped
        return {
            "path": paths[-1] if paths else str(self._path),
            "paths": paths,
            "ticks_logged": self._files.ticks_logged,
            "ticks_lost": lost,
            "events_lost": self._events_lost,
            "bytes": self._files.closed_bytes,
            "complete": self._is_complete(lost, result),
            "error": self.error,
        }

    def _write_remaining(self, result: str) -> None:
        """Write all waiting snapshots, messages and ticks; `result` tells how the loop ended, for subclasses."""
        while self._waiting_snapshots:
            self._pending.add_snapshot(self._waiting_snapshots.popleft())
        self._write_all()

    @property
    def _events_lost(self) -> int:
        """Number of the loop's events that were lost in the ring or dropped."""
        return self._events.lost + self._pending.dropped

    def _is_complete(self, lost: int, result: str) -> bool:
        """Whether no tick and no event was lost, no write failed, and `result` is "finished" or "rotated"."""
        return lost == 0 and self._events_lost == 0 and self.error is None and result in (FINISHED, ROTATED)

    def _handle_snapshot(self, tick: int) -> None:
        """Begin another file at the law's snapshot of `tick` if the present file is large or old enough.

        The ticks before `tick` are written first. While a failure prevents recording, try to resume with a new file
        instead if the run is paced, and do nothing if it is unpaced.
        """
        if self.failure:
            if self._header["paced"]:
                self._resume(tick)
        elif self._is_file_due(tick):
            self._write_chunks(self._buffer.count_before(tick), before=tick)
            if not self.failure:
                self._rotate(tick)

    def _is_file_due(self, tick: int) -> bool:
        """Whether another file is due at `tick`: the present one has `rotate_bytes`, or lasts `rotate_s` by then.

        False for a file that began at `tick` itself.
        """
        options, age_s = self._options, (tick - self._cut_tick) / self._header["rate_hz"]
        is_large = options.rotate_bytes is not None and self._files.size_bytes >= options.rotate_bytes
        is_old = options.rotate_s is not None and age_s >= options.rotate_s
        return (is_large or is_old) and tick > self._cut_tick

    def _rotate(self, tick: int) -> None:
        """Begin another file at `tick`, before which all ticks are written, and finish the present one.

        If the new file cannot be opened, recording stops: until a later snapshot in a paced run, for good in an unpaced
        one. If the old file cannot be finished, the error is reported and recording continues.
        """
        try:
            self._begin_next_file(tick, self._start_unix_ns() + self._tick_time(tick).time_ns)
        except OutputError as error:
            self._fail(error)

    def _begin_next_file(self, tick: int, log_time: int, room_bytes: int = 0) -> None:
        """Begin a file at the snapshot of `tick` and finish the present one.

        The present file is finished after the next one is open: without one, it must record the missing ticks. Raises
        OutputError, with the present file unchanged, if the next one cannot be opened.
        """
        writer = self._files.open_next(log_time, room_bytes)
        self._finish_file(ROTATED, "rotated", self._files.end_place.tick, tick)
        self._files.switch(writer)
        self._cut_tick = tick

    def _tick_time(self, tick: int) -> TickTime:
        """Return `tick` with its deadline, as `TickBuffer.tick_time`."""
        return self._buffer.tick_time(tick)

    def _finish_file(self, kind: str, result: str, end_tick: int, event_tick: int) -> None:
        """Finish the file, which accounts for the ticks before `end_tick`; its last event is at `event_tick`.

        `kind` of that event is FINISHED or ROTATED; `result` tells how the loop ended, "rotated" for ROTATED. An error
        sets `error`; after a rotation it is also queued as an event and stored in the block (RECORDER_FAILURE), and
        recording continues.
        """
        writer = self._files.writer

        def final_message(ticks_logged: int) -> Message:
            """Return the event that ends the file, with the totals if it holds `ticks_logged` ticks."""
            ticks_skipped = writer.ticks_skipped if writer else 0
            lost = end_tick - self._files.file_begin.tick - ticks_logged - ticks_skipped
            totals = {"ticks_executed": end_tick, "ticks_logged": ticks_logged, "ticks_lost": lost}
            totals |= {"events_lost": self._events_lost, "snapshots_lost": self._snapshots.lost, "result": result}
            details = {**totals, "complete": self._is_complete(lost, result), "error": self.error}
            details |= {"ticks_skipped": ticks_skipped} if self._header.get("around") else {}
            details |= {"driver_error": self._block.fault} if kind == FINISHED else {}
            return self._pending.recorder_message(kind, self._tick_time(event_tick), details)

        if problem := self._files.finish(final_message):
            self.error = self.error or str(problem)
            if kind == ROTATED:
                details = {"error": str(problem)}
                self._pending.add_event(recorder_event(RECORDING_FAILED, *self._tick_time(event_tick), details))
                self._block.store(Word.RECORDER_FAILURE, problem.number or errno.EIO)

    def _fail(self, error: OutputError) -> None:
        """Queue the event of a failed write, and stop recording until a file can be begun.

        The first failure also sets `error`.
        """
        self.error = self.error or str(error)
        self._pending.add_event(recorder_event(RECORDING_FAILED, *self._failure_time(), {"error": str(error)}))
        self._stop_recording(error)

    def _failure_time(self) -> TickTime:
        """Tick and deadline of the event of a failed write: the tick after the last one in a file."""
        return self._files.end_place

    def _stop_recording(self, failure: OutputError) -> None:
        """Stop recording for the reason `failure`: discard an unusable file, store reason and progress in the block."""
        self.failure = failure
        self._files.discard_unusable()
        self._store_progress(self._files.end_place.tick)
        self._block.store(Word.RECORDER_FAILURE, failure.number or errno.EIO)

    def _resume(self, tick: int) -> None:
        """Try to continue in another file at the snapshot of `tick`; `_begin_after_failure` tells where it begins.

        Success queues the event RECORDING_RESUMED and clears `failure` and RECORDER_FAILURE; otherwise both get the
        new reason.
        """
        self._files.discard_unusable()
        room_bytes = RESUME_FREE_BYTES + self._options.min_free_bytes // 4
        try:
            self._begin_next_file(tick, self._pending.log_time(tick), room_bytes)
        except OutputError as error:
            self._stop_recording(error)
            return
        begin = self._begin_after_failure(tick)
        gap = {"first_tick": self._files.end_place.tick, "count": begin - self._files.end_place.tick}
        self._pending.add_event(recorder_event(RECORDING_RESUMED, *self._buffer.tick_time(tick), gap))
        self.failure = None
        self._store_progress(begin)
        self._block.store(Word.RECORDER_FAILURE, 0)

    def _begin_after_failure(self, tick: int) -> int:
        """Drop the ticks before the new file, begun at the snapshot of `tick`. Returns `tick`, its first tick."""
        self._buffer.drop(self._buffer.count_before(tick))
        return tick

    def _write_all(self) -> None:
        """Write all drained ticks and waiting messages; a failed write sets `failure`, as in `_write`."""
        self._write_chunks(len(self._buffer))

    def _write_chunks(self, count: int, before: float = math.inf) -> None:
        """Write the first `count` drained ticks, chunk by chunk, and the waiting messages before tick `before`.

        Each chunk of ticks comes after the messages before its last tick. A failed write sets `failure`, as in
        `_write`.
        """
        buffer, chunk_rows = self._buffer, self._buffer.chunk_rows
        with self._files.packing(buffer.rows[:count], self._start_unix_ns()):
            while count > chunk_rows:
                next_chunk_begin = int(buffer.rows[chunk_rows, TICK])
                self._write(chunk_rows, self._pending.take_entries(before=next_chunk_begin))
                count -= chunk_rows
            self._write(count, self._pending.take_entries(before=before))

    def _write(self, count: int, entries: list[PendingEntry]) -> None:
        """Write `entries`, then the first `count` rows, and drop these rows from the buffer.

        A failed write sets `failure` and does not raise. While no file can be written, rows and snapshots are lost and
        events wait.
        """
        self._last_write_s = timing.monotonic_s()
        if self.failure is None:
            try:
                self._write_to_file(self._buffer.rows[:count], entries)
            except OutputError as error:
                self._fail(error)
        if self.failure:
            self._pending.requeue_events(entries)
        self._buffer.drop(count)

    def _write_to_file(self, rows: Real, entries: list[PendingEntry], intervals: Intervals | None = None) -> None:
        """Write entries and gap events, then rows or, if not None, intervals of omitted ticks.

        The write is announced in the block for a replacement recorder, and RECORDER_FAILURE set to 0 after it. Raises
        OutputError if it fails.
        """
        end, messages = self._files.end_place, [entry.message for entry in entries]
        spans, rate_hz = TickSpans(rows, intervals), self._header["rate_hz"]
        if gaps := spans.gaps(end.tick):
            for first, missing in gaps:
                tick_time = end if first == end.tick else spans.tick_time(first, rate_hz)
                messages.append(self._pending.recorder_message(GAP, tick_time, {"first_tick": first, "count": missing}))
            messages.sort(key=lambda message: message.log_time)
        if spans.tick_count:
            end = spans.tick_time(spans.end, rate_hz)
        position = RingPosition(
            end.tick,
            self._snapshots.position - len(self._waiting_snapshots) - self._count_pending(format.LAW),
            self._events.position - self._count_pending(format.EVENTS),
            end.tick - self._files.ticks_logged - self._files.ticks_skipped - spans.tick_count,
        )
        with self._progress.announced_write(self._files.size_bytes, position.furthest(self._predecessor_end)):
            self._files.write(messages, rows, intervals, self._start_unix_ns(), end)
        self._block.store(Word.RECORDER_FAILURE, 0)

    def _count_pending(self, channel: int) -> int:
        """Count the unwritten messages with channel id `channel` from the rings, without the recorder's own events."""
        return self._pending.count_pending(channel)

    def _store_progress(self, tick: int) -> None:
        """Store in the block that all ticks before `tick` are in a file or lost; positions of the other rings stay."""
        lost = tick - self._files.ticks_logged - self._files.ticks_skipped
        self._progress.store_flushed(self._progress.flushed_position._replace(ticks=tick, lost=lost))

    def _start_unix_ns(self) -> int:
        """Start of the run in UNIX ns: by the block or, before the block has it, by the header.

        0 in virtual time, so that two unpaced runs have the same log times.
        """
        if not self._header["paced"]:
            return 0
        return self._block.load(Word.START_UNIX_NS) or self._header["created_unix_ns"]
