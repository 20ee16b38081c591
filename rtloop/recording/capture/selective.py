"""A recording around events: what is drained goes through a memory, and from there into the file, or is summed up.

The files account for all ticks up to the oldest that waits in the memory; a recorder that takes another one's place
finds the rest in the rings. While nothing can be written, what is worth keeping waits as long as there is room.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rtloop.engine.memory import SharedBlock
from rtloop.errors import OutputError
from rtloop.recording.capture.buffer import Place
from rtloop.recording.capture.files import Options
from rtloop.recording.capture.memory import Batch, Memory
from rtloop.recording.capture.names import Names
from rtloop.recording.capture.pending import Entry
from rtloop.recording.capture.session import Session
from rtloop.recording.file.around import Around
from rtloop.recording.file.topics.events import FINISHED, KEPT, recorder_event


class SelectiveSession(Session):
    """As a Session; `header` says around what."""

    def __init__(
        self, block: SharedBlock, path: Path, header: dict[str, Any], options: Options, names: Names | None = None
    ) -> None:
        super().__init__(block, path, header, options, names)
        window, rate_hz = Around.of(header), header["rate_hz"]
        assert window is not None
        # nobody knows how long the one before was to go on
        retain_until = -1 if options.sequence == 1 else self._reached.ticks + round(window.after_s * rate_hz)
        self._memory = Memory(window, header["columns"], rate_hz, self.cursor, retain_until)

    def _meet_snapshot(self, tick: int) -> None:
        self._write(self._buffer.before(tick), self._pending.take(before=tick))
        self._memory.cut(tick)
        if self.failure and self._header["paced"]:
            self._resume(tick)
        self._pass_on()

    def _write_all(self) -> None:
        """An event or a snapshot waits for its tick, so that all of them come in the order of their ticks."""
        if count := len(self._buffer):
            self._write(count, self._pending.take(before=self._buffer.end))

    def _write(self, count: int, entries: list[Entry]) -> None:
        """Into the memory, and from there what is decided."""
        self._note_write()
        rows = self._buffer.first(count).copy()
        for hit in self._memory.find(entries, rows):
            event = recorder_event(KEPT, *self._buffer.place(hit.first), {"on": hit.condition})
            entries.append(self._pending.entry(event))
        entries.sort(key=lambda entry: entry.message.log_time)
        self._memory.add(entries, rows)
        self._buffer.drop(count)
        self._pass_on()

    def _write_the_rest(self, result: str) -> None:
        super()._write_the_rest(result)
        self._write(0, self._pending.take())
        if result != FINISHED:
            self._memory.keep_all()
        self._pass_on(end=True)

    def _pass_on(self, *, end: bool = False) -> None:
        while self.failure is None and (batch := self._memory.next(self._file_is_due, end=end)) is not None:
            try:
                self._pass(batch)
            except OutputError as error:
                self._memory.put_back(batch)
                self._fail(error)
        if self.failure:
            self._pending.drop(self._memory.make_room())

    def _pass(self, batch: Batch) -> None:
        if batch.cut is not None:
            self._rotate(batch.cut)
        else:
            self._write_to_file(batch.rows, batch.entries, batch.intervals if len(batch.intervals) else None)

    def _begin_behind_failure(self, tick: int) -> int:
        self._memory.begin_file()
        return self._memory.begin

    def _finish_file(self, kind: str, result: str, end_tick: int, said_tick: int) -> None:
        """What waits, and goes into the next file, was before `said_tick`."""
        super()._finish_file(kind, result, end_tick, min(end_tick, said_tick))

    def _waiting(self, channel: int) -> int:
        return super()._waiting(channel) + self._memory.waiting(channel)

    def _place(self, tick: int) -> Place:
        """What was handed on is known exactly; what waits is behind it."""
        return self._files.next if tick == self._files.next.tick else super()._place(tick)

    def _failed_at(self) -> Place:
        """Behind all events that wait."""
        return self._buffer.place(self.cursor)
