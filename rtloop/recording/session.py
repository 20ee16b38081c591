"""One run's recording: what was drained from the rings and is not yet in the file, and the file or files.

Order: ticks are drained before snapshots, these before events, and ticks are written last. A tick in the file
therefore always finds the snapshot and the commands that precede it in front of it, and a snapshot at which the file
is rotated finds all events before it drained.
"""

from __future__ import annotations

import hashlib
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtloop.engine.memory import SharedBlock, Word
from rtloop.errors import OutputError
from rtloop.recording import format
from rtloop.recording.contents import Message
from rtloop.recording.events import FINISHED, GAP, ROTATED, event_of, recorder_event
from rtloop.recording.rings import RingReader
from rtloop.recording.writer import Writer
from rtloop.signals import DEADLINE, TICK

FLUSH_S = 0.5
FLUSHED = {"ticks": Word.FLUSHED_TICKS, "snapshots": Word.FLUSHED_SNAPSHOTS, "events": Word.FLUSHED_EVENTS}
NS_PER_S = 1e9


class Options(NamedTuple):
    """Choices of a run. A rotated recording is NAME-0001.mcap, NAME-0002.mcap, …, each cut at a state snapshot."""

    rotate_bytes: int | None = None
    rotate_s: float | None = None
    min_free_bytes: int = 64 << 20
    message_index: bool = False
    sequence: int = 1
    """Number of the first file: above 1 where another recorder of the same run died."""


class Session:
    """Drains the rings of `block` and writes `path`. After an error it goes on draining and counts the loss."""

    def __init__(self, block: SharedBlock, path: Path, header: dict[str, Any], options: Options) -> None:
        self._block, self._path, self._header, self._options = block, path, header, options
        self._rows = np.empty((format.chunk_rows(header["columns"]), len(header["columns"])))
        self._fill, self._written_s = 0, time.monotonic()
        self._anchor = (0.0, 0.0)
        self._ticks, self._snapshots, self._events = (
            RingReader(block, name, int(block.words[word])) for name, word in FLUSHED.items()
        )
        self._pending: list[tuple[int, Message]] = []
        self._paths: list[Path] = []
        self._first_tick, self._logged, self._bytes = self._ticks.position, 0, 0
        self._begin_tick = self._first_tick
        self.error: str | None = None
        self._writer = self._open(header["created_unix_ns"] if header["paced"] else 0)

    @property
    def cursor(self) -> int:
        """Ticks taken from the ring or lost to it."""
        return self._ticks.position

    @property
    def room(self) -> int:
        """Ticks that the next drain can take."""
        return len(self._rows) - self._fill

    def drain(self) -> int:
        """Copy what the rings hold; returns the number of ticks and messages taken or found lost."""
        start = self._ticks.position
        copied, lost = self._ticks.take_into(self._rows[self._fill :])
        self._fill += copied
        if lost:
            gap = recorder_event(GAP, start, self._time_ns(start), {"first_tick": start, "count": lost})
            self._add(format.EVENTS, start, json.dumps(gap))
        snapshots, events = self._snapshots.take(), self._events.take()
        for message in events:
            tick = int(message["tick"])
            self._add(format.EVENTS, tick, json.dumps(event_of(message, self._header["axes"], self._time_ns(tick))))
        for data in map(bytes, snapshots):
            tick = int.from_bytes(data[:8], "little")
            self._rotate_if_due(tick)
            self._add(format.LAW, tick, hashlib.sha256(data).digest() + data)
        return copied + lost + len(snapshots) + len(events)

    def write_due(self) -> None:
        """Write when a chunk is full or the last write is FLUSH_S ago."""
        if self.room == 0 or time.monotonic() - self._written_s >= FLUSH_S:
            self._write(self._fill, self._pending)
            self._pending = []

    def finish(self, result: str) -> dict[str, Any]:
        """Write the rest and the end; returns the totals that the recorder prints."""
        self._write(self._fill, self._pending)
        self._close(FINISHED, result, self.cursor)
        lost = self.cursor - self._begin_tick - self._logged
        return {
            "path": str(self._paths[-1]),
            "paths": [str(path) for path in self._paths],
            "ticks_logged": self._logged,
            "ticks_lost": lost,
            "events_lost": self._events.lost,
            "bytes": self._bytes,
            "complete": self._complete(lost, result),
            "error": self.error,
        }

    def _complete(self, lost: int, result: str) -> bool:
        return lost == 0 and self._events.lost == 0 and self.error is None and result in (FINISHED, ROTATED)

    def _open(self, log_time: int) -> Writer:
        path, header = self._path, self._header
        if self._options.rotate_bytes or self._options.rotate_s or self._options.sequence > 1:
            sequence = len(self._paths) + self._options.sequence
            path = path.with_name(f"{path.stem}-{sequence:04d}{path.suffix}")
            header = {**header, "sequence": sequence, "first_tick": self._first_tick}
        self._paths.append(path)
        return Writer(
            path,
            header,
            log_time,
            message_index=self._options.message_index,
            min_free_bytes=self._options.min_free_bytes,
        )

    def _close(self, kind: str, result: str, end_tick: int) -> None:
        """Finish the file, which covers the ticks from `_first_tick` to before `end_tick`."""

        def final(logged: int) -> Message:
            lost = end_tick - self._first_tick - logged
            totals = {"ticks_executed": end_tick, "ticks_logged": logged, "ticks_lost": lost}
            totals |= {"events_lost": self._events.lost, "snapshots_lost": self._snapshots.lost, "result": result}
            what = {**totals, "complete": self._complete(lost, result), "error": self.error}
            return self._message(
                format.EVENTS, end_tick, json.dumps(recorder_event(kind, end_tick, self._time_ns(end_tick), what))
            )

        try:
            self._writer.finish(final)
        except OutputError as error:
            self.error = self.error or str(error)
            self._writer.close()
        self._logged += self._writer.ticks
        self._bytes += self._writer.size_bytes

    def _rotate_if_due(self, tick: int) -> None:
        """Go on in the next file, from `tick` on, if this one is large or long enough."""
        options, age = self._options, (tick - self._first_tick) / self._header["rate_hz"]
        large = options.rotate_bytes is not None and self._writer.size_bytes >= options.rotate_bytes
        long = options.rotate_s is not None and age >= options.rotate_s
        if not (large or long) or tick == self._first_tick or self.error:
            return
        early = [entry for entry in self._pending if entry[0] < tick]
        self._pending = [entry for entry in self._pending if entry[0] >= tick]
        self._write(int(np.searchsorted(self._rows[: self._fill, TICK], tick)), early)
        self._close(ROTATED, "rotated", tick)
        self._first_tick = tick
        try:
            self._writer = self._open(self._start_unix_ns() + self._time_ns(tick))
        except OutputError as error:
            self.error = self.error or str(error)

    def _write(self, count: int, messages: list[tuple[int, Message]]) -> None:
        """Messages, then the first `count` rows; the rows behind them move to the front."""
        self._written_s = time.monotonic()
        if self.error is None:
            try:
                self._writer.start_unix_ns = self._start_unix_ns()
                self._writer.write_messages([message for _, message in messages])
                self._writer.write_ticks(self._rows[:count])
            except OutputError as error:
                self.error = str(error)
        if count:
            self._anchor = (self._rows[count - 1, TICK], self._rows[count - 1, DEADLINE])
        self._say_flushed(count)
        rest = self._fill - count
        self._rows[:rest] = self._rows[count : self._fill].copy()
        self._fill = rest

    def _say_flushed(self, count: int) -> None:
        """Positions up to which everything is in the file, or lost."""
        if count == self._fill:
            for reader, word in zip((self._ticks, self._snapshots, self._events), FLUSHED.values(), strict=True):
                self._block.words[word] = reader.position

    def _start_unix_ns(self) -> int:
        """Virtual time starts at 0, so that two unpaced runs are logged alike."""
        if not self._header["paced"]:
            return 0
        return int(self._block.words[Word.START_UNIX_NS]) or self._header["created_unix_ns"]

    def _time_ns(self, tick: int) -> int:
        """When `tick` was due, since the start: from its row or the last one before it, else by the period."""
        base_tick, base_ns = self._anchor
        row = int(np.searchsorted(self._rows[: self._fill, TICK], tick, side="right")) - 1
        if row >= 0:
            base_tick, base_ns = self._rows[row, TICK], self._rows[row, DEADLINE]
        return round(base_ns + (tick - base_tick) * NS_PER_S / self._header["rate_hz"])

    def _message(self, channel: int, tick: int, payload: bytes | str) -> Message:
        data = payload.encode() if isinstance(payload, str) else payload
        return Message(channel, self._start_unix_ns() + self._time_ns(tick), data)

    def _add(self, channel: int, tick: int, payload: bytes | str) -> None:
        self._pending.append((tick, self._message(channel, tick, payload)))
