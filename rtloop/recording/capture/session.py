"""One run's recording: what was drained from the rings and is not yet in the file, and the file or files.

Order: ticks are drained before snapshots, these before events, and ticks are written last. A tick in the file
therefore always finds the snapshot and the commands that precede it in front of it. A snapshot waits until all ticks
before it were drained: a file can be cut there, however far the loop is ahead.
"""

from __future__ import annotations

import errno
import time
from collections import deque
from pathlib import Path
from typing import Any

from rtloop.engine.memory import SharedBlock, Word
from rtloop.errors import OutputError
from rtloop.recording.capture.buffer import Place, Rows, Spans, TickBuffer
from rtloop.recording.capture.files import Files, Options, left_by_another
from rtloop.recording.capture.names import Names
from rtloop.recording.capture.pending import Entry, Pending, tick_of
from rtloop.recording.capture.progress import Position, Progress
from rtloop.recording.capture.rings import RingReader
from rtloop.recording.capture.successor import snapshot_before
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.events import (
    FINISHED,
    GAP,
    RECORDING_FAILED,
    RECORDING_RESUMED,
    REMOVED,
    ROTATED,
    event_of,
    recorder_event,
)
from rtloop.recording.file.topics.overview import Intervals

FLUSH_S = 0.5
ROOM_BYTES = 1 << 20
"""Must be free, and a quarter more than is to stay free, before a file is begun after a failure: it is to last."""


class Session:
    """Drains the rings of `block` and writes `path`.

    Where that fails it goes on draining, counts the loss, and tries a new file at every snapshot: `failure` says why
    nothing is recorded now, `error` what came first. An unpaced run waits for its recorder: it is not tried again.
    """

    def __init__(
        self, block: SharedBlock, path: Path, header: dict[str, Any], options: Options, names: Names | None = None
    ) -> None:
        self._names = names
        self._block, self._path, self._header, self._options = block, path, header, options
        self._laws = [law["name"] for law in header.get("law", {}).get("laws", ())]
        self._buffer = TickBuffer(header["columns"], header["rate_hz"])
        self._written_s = time.monotonic()
        self._progress = Progress(block)
        self._reached = self._progress.found(left_by_another(path, options.sequence))
        self._progress.note(self._reached)
        self._ahead: deque[bytes] = deque()
        self._pending = Pending(self._buffer, self._start_unix_ns)
        self.error: str | None = None
        self.failure: OutputError | None = None
        snapshot = snapshot_before(block, self._reached) if options.sequence > 1 else None
        self._begin_at(snapshot or self._reached, repeats=snapshot is not None)
        try:
            self._files.begin(self._files.opened(header["created_unix_ns"] if header["paced"] else 0))
        except OutputError as error:
            if options.sequence == 1:
                raise
            self._begin_at(self._reached, repeats=False)
            self._fail(error)

    def _begin_at(self, position: Position, *, repeats: bool) -> None:
        """Read the rings from `position` on; `repeats`: what an earlier recorder's file has of it is written again."""
        self._ticks = RingReader(self._block, "ticks", position.ticks)
        self._snapshots = RingReader(self._block, "snapshots", position.snapshots)
        self._events = RingReader(self._block, "events", position.events)
        begin, end = (self._buffer.place(tick) for tick in (position.ticks, self._reached.ticks))
        ticks_logged = position.ticks - position.lost
        self._files = Files(self._path, self._header, self._options, begin, ticks_logged, end if repeats else None)
        self._cut_tick = position.ticks

    @property
    def cursor(self) -> int:
        """Ticks taken from the ring or lost to it."""
        return self._ticks.position

    @property
    def room(self) -> int:
        """Ticks that the next drain can take."""
        return self._buffer.room

    def drain(self) -> int:
        """Copy what the rings hold; returns the number of ticks and messages taken or found lost."""
        ticks = self._buffer.take_from(self._ticks)
        snapshots, events = self._snapshots.take(), self._events.take()
        for message in events:
            time_ns = self._buffer.time_ns(int(message["tick"]))
            name = self._names and self._names.of(int(message["identity"]))
            self._pending.add_event(event_of(message, self._header["axes"], time_ns, self._laws, name))
        self._ahead.extend(map(bytes, snapshots))
        while self._ahead and (tick := tick_of(self._ahead[0])) <= self.cursor:
            self._meet_snapshot(tick)
            self._pending.add_snapshot(self._ahead.popleft())
        return ticks + len(snapshots) + len(events)

    def note_removed(self, what: dict[str, Any]) -> None:
        """A file, of this run or another, was removed for this one's sake."""
        self._pending.add_event(recorder_event(REMOVED, *self._buffer.place(self.cursor), what))

    def write_due(self) -> None:
        """Write when a chunk is full or the last write is FLUSH_S ago."""
        if self.room == 0 or time.monotonic() - self._written_s >= FLUSH_S:
            self._write_all()

    def finish(self, result: str) -> dict[str, Any]:
        """Write the rest and the end; returns the totals that the recorder prints."""
        self._write_the_rest(result)
        self._pending.drop(self._pending.take())
        self._finish_file(FINISHED, result, self.cursor, self.cursor)
        if self._files.next.tick >= self._reached.ticks:  # the end of the file may have cost it ticks
            self._account(self._files.next.tick)
        paths = [str(path) for path in self._files.paths]
        lost = self.cursor - self._files.logged - self._files.skipped
        return {
            "path": paths[-1] if paths else str(self._path),
            "paths": paths,
            "ticks_logged": self._files.logged,
            "ticks_lost": lost,
            "events_lost": self._events_lost,
            "bytes": self._files.closed_bytes,
            "complete": self._complete(lost, result),
            "error": self.error,
        }

    def _write_the_rest(self, result: str) -> None:
        while self._ahead:
            self._pending.add_snapshot(self._ahead.popleft())
        self._write_all()

    @property
    def _events_lost(self) -> int:
        return self._events.lost + self._pending.dropped

    def _complete(self, lost: int, result: str) -> bool:
        return lost == 0 and self._events_lost == 0 and self.error is None and result in (FINISHED, ROTATED)

    def _meet_snapshot(self, tick: int) -> None:
        """Go on in another file from the snapshot of `tick` on: after a failure, or where this one is large enough."""
        if self.failure:
            if self._header["paced"]:
                self._resume(tick)
        elif self._file_is_due(tick):
            self._write(self._buffer.before(tick), self._pending.take(before=tick))
            if not self.failure:
                self._rotate(tick)

    def _file_is_due(self, tick: int) -> bool:
        """Whether the present file is large enough, where a snapshot of `tick` follows."""
        options, age_s = self._options, (tick - self._cut_tick) / self._header["rate_hz"]
        is_large = options.rotate_bytes is not None and self._files.size_bytes >= options.rotate_bytes
        is_old = options.rotate_s is not None and age_s >= options.rotate_s
        return (is_large or is_old) and tick > self._cut_tick

    def _rotate(self, tick: int) -> None:
        """Go on in another file; all before `tick` is written.

        The present file is finished once there is another: where none can be begun, it has to tell what is missing.
        """
        try:
            writer = self._files.opened(self._start_unix_ns() + self._place(tick).time_ns)
        except OutputError as error:
            self._fail(error)
            return
        self._finish_file(ROTATED, "rotated", self._files.next.tick, tick)
        self._files.begin(writer)
        self._cut_tick = tick

    def _place(self, tick: int) -> Place:
        return self._buffer.place(tick)

    def _finish_file(self, kind: str, result: str, end_tick: int, said_tick: int) -> None:
        """Finish the file, which accounts for the ticks before `end_tick`; the event that ends it is of `said_tick`."""

        writer = self._files.writer

        def final(logged: int) -> Message:
            ticks_skipped = writer.skipped if writer else 0
            lost = end_tick - self._files.first.tick - logged - ticks_skipped
            totals = {"ticks_executed": end_tick, "ticks_logged": logged, "ticks_lost": lost}
            totals |= {"events_lost": self._events_lost, "snapshots_lost": self._snapshots.lost, "result": result}
            details = {**totals, "complete": self._complete(lost, result), "error": self.error}
            details |= {"ticks_skipped": ticks_skipped} if self._header.get("around") else {}
            details |= {"driver_error": self._block.fault} if kind == FINISHED else {}
            return self._pending.own(kind, self._place(said_tick), details)

        if problem := self._files.finish(final):
            self.error = self.error or str(problem)
            if kind == ROTATED:
                what = {"error": str(problem)}
                self._pending.add_event(recorder_event(RECORDING_FAILED, *self._place(said_tick), what))
                self._block.store(Word.RECORDER_FAILURE, problem.number or errno.EIO)

    def _fail(self, error: OutputError) -> None:
        """Nothing is recorded from here on, until a file could be begun."""
        self.error = self.error or str(error)
        self._pending.add_event(recorder_event(RECORDING_FAILED, *self._failed_at(), {"error": str(error)}))
        self._say(error)

    def _failed_at(self) -> Place:
        return self._files.next

    def _say(self, failure: OutputError) -> None:
        """Why nothing is recorded, and which tick is the first that is in no file."""
        self.failure = failure
        self._files.leave_what_is_useless()
        self._account(self._files.next.tick)
        self._block.store(Word.RECORDER_FAILURE, failure.number or errno.EIO)

    def _resume(self, tick: int) -> None:
        """Try to go on in another file from the snapshot of `tick` on; the rows before it are lost."""
        self._files.leave_what_is_useless()
        room_bytes = ROOM_BYTES + self._options.min_free_bytes // 4
        try:
            writer = self._files.opened(self._pending.log_time(tick), room_bytes)
        except OutputError as error:
            self._say(error)
            return
        self._finish_file(ROTATED, "rotated", self._files.next.tick, tick)
        self._files.begin(writer)
        begin = self._begin_behind_failure(tick)
        gap = {"first_tick": self._files.next.tick, "count": begin - self._files.next.tick}
        self._pending.add_event(recorder_event(RECORDING_RESUMED, *self._buffer.place(tick), gap))
        self._cut_tick, self.failure = tick, None
        self._account(begin)
        self._block.store(Word.RECORDER_FAILURE, 0)

    def _begin_behind_failure(self, tick: int) -> int:
        """The first tick that will be in the new file, which was begun at the snapshot of `tick`."""
        self._buffer.drop(self._buffer.before(tick))
        return tick

    def _write_all(self) -> None:
        self._write(len(self._buffer), self._pending.take())

    def _note_write(self) -> None:
        self._written_s = time.monotonic()

    def _write(self, count: int, entries: list[Entry]) -> None:
        """Entries, then the first `count` rows. Where nothing can be written, rows are lost and events are kept."""
        self._note_write()
        if self.failure is None:
            try:
                self._write_to_file(self._buffer.first(count), entries)
            except OutputError as error:
                self._fail(error)
        if self.failure:
            self._pending.keep_events(entries)
        self._buffer.drop(count)

    def _write_to_file(self, rows: Rows, entries: list[Entry], intervals: Intervals | None = None) -> None:
        """Entries, then rows, or what is kept of those that are left out. Raises OutputError."""
        end, messages = self._files.next, [entry.message for entry in entries]
        spans, rate_hz = Spans(rows, intervals), self._header["rate_hz"]
        if gaps := spans.gaps(end.tick):
            for first, missing in gaps:
                tick_time = end if first == end.tick else spans.place(first, rate_hz)
                messages.append(self._pending.own(GAP, tick_time, {"first_tick": first, "count": missing}))
            messages.sort(key=lambda message: message.log_time)
        if spans.ticks:
            end = spans.place(spans.end, rate_hz)
        position = Position(
            end.tick,
            self._snapshots.position - len(self._ahead) - self._waiting(format.LAW),
            self._events.position - self._waiting(format.EVENTS),
            end.tick - self._files.logged - self._files.skipped - spans.ticks,
        )
        with self._progress.writing(self._files.size_bytes, position.at_least(self._reached)):
            if intervals is None:
                self._files.write(messages, rows, self._start_unix_ns(), end)
            else:
                self._files.leave_out(messages, intervals, self._start_unix_ns(), end)
        self._block.store(Word.RECORDER_FAILURE, 0)

    def _waiting(self, channel: int) -> int:
        """Messages of a topic that were taken from the rings, and wait."""
        return self._pending.waiting(channel)

    def _account(self, tick: int) -> None:
        """Ticks before `tick` are in a file, or lost; snapshots and events may still be found in the rings."""
        lost = tick - self._files.logged - self._files.skipped
        self._progress.note(self._progress.written._replace(ticks=tick, lost=lost))

    def _start_unix_ns(self) -> int:
        """Virtual time starts at 0, so that two unpaced runs are logged alike."""
        if not self._header["paced"]:
            return 0
        return self._block.load(Word.START_UNIX_NS) or self._header["created_unix_ns"]
