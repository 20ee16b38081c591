"""Reads a recording, finished or not, a chunk at a time, and says what is missing from it.

Every value that is handed out was under a checksum: that of its chunk, and for snapshots and the configuration a
SHA-256 as well. What has no checksum (the header of the file and of a chunk, the index of an unfinished file) is used
to find chunks only.
"""

from __future__ import annotations

import hashlib
import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from rtloop.hil.trusted import open_named
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.account import Account
from rtloop.recording.file.layout import open_layout
from rtloop.recording.file.mcap.chunks import Entry, Opener, Source
from rtloop.recording.file.mcap.container import DamagedChunk
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.checked import Malformed, event_from
from rtloop.recording.file.topics.contents import (
    Message,
    is_ticks,
    may_hold,
    may_tell,
    overlaps,
    split_messages,
)
from rtloop.recording.file.topics.events import FINAL, RECORDER, Event
from rtloop.recording.file.topics.overview import Intervals, OverviewLayout, Range, plausible, ranges
from rtloop.recording.file.topics.ticks import LARGEST, TickLayout, Ticks

Rows = np.ndarray[Any, Any]
WORKERS = 3
AHEAD = 16
"""Chunks that are decompressed beyond the one that is asked for."""
DIGEST_BYTES = 32


class Snapshot(NamedTuple):
    """The law at the beginning of a tick: the bytes after the tick's number are the law's own."""

    tick: int
    data: bytes


class Reader:
    """An open recording. `tolerant`: what is damaged is left out and named in `problems` instead of raising.

    `left_out` are those of the problems for which something is missing from what is read. `opener` opens the file:
    `open_named` of `rtloop.hil.trusted` for one that a user named, another for one found in a folder.

    Raises RecordingError, here and while reading.
    """

    def __init__(self, path: Path | str, *, tolerant: bool = False, opener: Opener = open_named) -> None:
        self.path, self.tolerant = Path(path), tolerant
        self._source = Source(self.path, opener)
        self.size_bytes: int = self._source.size
        """Size of the file."""
        try:
            self._source, self._layout = open_layout(self._source)
        except BaseException:
            self._source.close()
            raise
        self.header: dict[str, Any] = self._layout.header
        self._entries = self._layout.entries
        self.problems = [*self._layout.problems]
        self.left_out = [*self._layout.left_out]
        self.columns: tuple[str, ...] = tuple(self.header["columns"])
        self._ticks, self._overview = TickLayout(self.columns), OverviewLayout(self.columns)
        self.first_tick: int = self.header.get("first_tick", 0)
        self._repeated_before, self._end_tick = 0, round(LARGEST) + 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def begin_at(self, tick: int) -> None:
        """Take nothing before `tick`, which parts of the run before this one hold; some of it may stand here again."""
        self._repeated_before = min(self.header.get("repeats_before", 0), tick)
        self.first_tick = max(self.first_tick, tick)

    def end_at(self, tick: int) -> None:
        """Leave the events and snapshots from `tick` on to a later part, which holds them as well."""
        self._end_tick = min(self._end_tick, tick)

    def owns(self, tick: int) -> bool:
        """Whether the loop's events and snapshots of a tick are to be taken from this part of the run."""
        return self._repeated_before <= tick < self._end_tick

    @property
    def repeated(self) -> int:
        """Ticks at the beginning of the file that are taken from a part before it."""
        return max(self._repeated_before - self.header.get("first_tick", 0), 0)

    @cached_property
    def start_unix_ns(self) -> int:
        """When the run started: log time minus deadline of the first tick; the header's time if there is none."""
        for entry in self.tick_chunks:
            try:
                content = self._content(entry)
                if is_ticks(content):
                    return self._ticks.start_ns(content)
            except DamagedChunk:
                continue
        return int(self.header["created_unix_ns"])

    @property
    def entries(self) -> list[Entry]:
        """All chunks, in the order of the file."""
        return self._entries

    def chunk(self, entry: Entry) -> Ticks | list[Message] | None:
        """What a chunk holds: its ticks or its messages of the slow topics; None where it is damaged."""
        try:
            content = self._content(entry)
            if is_ticks(content):
                return self._ticks.ticks(content, self.columns)
            return self._checked(split_messages(content))
        except DamagedChunk as reason:
            self._leave_out(entry, reason)
            return None

    @property
    def tick_chunks(self) -> list[Entry]:
        """The chunks that may hold ticks."""
        return [entry for entry in self._entries if may_hold(entry, format.TICKS)]

    def chunks_between(self, start_s: float, end_s: float) -> list[Entry] | None:
        """The chunks that may hold ticks due between two times, in s since the start; None stands for all of them."""
        if start_s <= 0.0 and math.isinf(end_s):
            return None
        start_ns, end_ns = start_s * 1e9 + self.start_unix_ns, end_s * 1e9 + self.start_unix_ns
        return [entry for entry in self.tick_chunks if overlaps(entry, start_ns, end_ns)]

    def blocks(self, names: Sequence[str] | None = None, entries: Iterable[Entry] | None = None) -> Iterator[Rows]:
        """Arrays (n, columns) float64 of consecutive ticks in order; only the columns `names`, if given.

        `entries` restricts it to some of `tick_chunks`. Decompression runs ahead in threads.
        """
        columns = self._known(self.columns if names is None else names)
        account = Account(self.first_tick, self.totals, self._repeated_before)
        for entry, future in self._ahead(self.tick_chunks if entries is None else entries, columns):
            try:
                ticks = future.result()
                if ticks is not None and (ticks := account.add(ticks)) is not None:
                    yield ticks.rows
            except DamagedChunk as reason:
                self._leave_out(entry, reason)
        if entries is None:
            self._close(account)

    def snapshots(self, before: int = -1) -> Iterator[Snapshot]:
        """The snapshots of the law behind tick `before`, in order, each verified by its digest."""
        for message in self._messages(format.LAW):
            tick, data = tick_of(message), message.payload[DIGEST_BYTES:]
            if not self.owns(tick):
                continue
            if tick > before:
                yield Snapshot(tick, data)
            else:
                self._report(f"snapshots of the law are out of order: that of tick {tick} comes after {before}")
            before = max(before, tick)

    def chunks(self) -> Iterator[tuple[Rows | None, list[Message]]]:
        """Each chunk in the order of the file: either its ticks or its messages of the slow topics."""
        account = Account(self.first_tick, self.totals)
        for entry in self._entries:
            try:
                content = self._content(entry)
                if is_ticks(content):
                    ticks = self._ticks.ticks(content, self.columns)
                    account.add(ticks)
                    yield ticks.rows, []
                else:
                    yield None, self._checked(split_messages(content))
            except DamagedChunk as reason:
                self._leave_out(entry, reason)
        self._close(account)

    @property
    def events(self) -> list[Event]:
        """The events, in the order of the file."""
        return [event for event in self._events if event["who"] == RECORDER or self.owns(event["tick"])]

    @cached_property
    def _events(self) -> list[Event]:
        """All events that stand in the file, repeated ones too."""
        return [event_from(message.payload, self.header["axes"]) for message in self._messages(format.EVENTS)]

    @cached_property
    def overview(self) -> Intervals:
        """Of what was left out by intention (n, columns, 3), in order; see `rtloop.recording.file.topics.overview`."""
        intervals = self.intervals_of(self._messages(format.OVERVIEW))
        is_plausible = plausible(intervals)
        if not is_plausible.all():
            self._report("an overview is about no ticks, or about some that another one is about")
        return intervals[is_plausible]

    def intervals_of(self, messages: Iterable[Message]) -> Intervals:
        """What those of `/overview` among messages of this recording say."""
        return self._overview.intervals([message.payload for message in messages if message.channel == format.OVERVIEW])

    @cached_property
    def skipped(self) -> list[Range]:
        """The ticks that were left out by intention: first one, how many."""
        return [
            (max(first, self.first_tick), first + count - max(first, self.first_tick))
            for first, count in ranges(self.overview)
            if first + count > self.first_tick
        ]

    @property
    def totals(self) -> dict[str, Any] | None:
        """What the recorder counted when it finished the file; None where it did not."""
        final_events = [event for event in self._events if event["kind"] in FINAL]
        return final_events[-1]["what"] if final_events else None

    def _known(self, names: Sequence[str]) -> Sequence[str]:
        unknown = [name for name in names if name not in self.columns]
        if unknown:
            raise RecordingError(f"{self.path}: no signal {unknown[0]!r}; there are {', '.join(self.columns)}")
        return names

    def _content(self, entry: Entry) -> bytes:
        return self._layout.content(entry)

    def _ahead(self, entries: Iterable[Entry], names: Sequence[str]) -> Iterator[tuple[Entry, Future[Ticks | None]]]:
        """The entries with what comes of decompressing them."""
        queue: deque[tuple[Entry, Future[Ticks | None]]] = deque()
        with ThreadPoolExecutor(WORKERS) as pool:
            for entry in entries:
                queue.append((entry, pool.submit(self._ticks_of, entry, names)))
                if len(queue) >= AHEAD:
                    yield queue.popleft()
            while queue:
                yield queue.popleft()

    def _ticks_of(self, entry: Entry, names: Sequence[str]) -> Ticks | None:
        """The ticks of a chunk; None if it holds something else. Raises DamagedChunk."""
        content = self._content(entry)
        return self._ticks.ticks(content, names) if is_ticks(content) else None

    def _messages(self, channel: int) -> Iterator[Message]:
        """The messages of one of the slow topics; what is wrong with the others in their chunks is reported too."""
        for entry in self._entries:
            if may_tell(entry, channel):
                yield from (message for message in self._slow(entry) if message.channel == channel)

    def _slow(self, entry: Entry) -> list[Message]:
        """The messages of the slow topics in a chunk."""
        try:
            content = self._content(entry)
            return [] if is_ticks(content) else self._checked(split_messages(content))
        except DamagedChunk as reason:
            self._leave_out(entry, reason)
            return []

    def _checked(self, messages: list[Message]) -> list[Message]:
        """Those of the messages that say something; of the others it is reported what is wrong."""
        valid = []
        for message in messages:
            try:
                if message.channel == format.EVENTS:
                    event_from(message.payload, self.header["axes"])
                elif message.channel == format.LAW:
                    _require_digest(message)
                elif message.channel == format.OVERVIEW:
                    self._overview.require(message.payload)
                valid.append(message)
            except ValueError as reason:
                is_event = message.channel == format.EVENTS
                self._report(f"an event is malformed: {reason}" if is_event else str(reason))
        return valid

    def _leave_out(self, entry: Entry, reason: DamagedChunk) -> None:
        self._report(f"the chunk at byte {entry.offset} is damaged ({reason})")

    def _close(self, account: Account) -> None:
        if account.shortage and not self.left_out:
            self._report(account.shortage)

    def _report(self, problem: str) -> None:
        if not self.tolerant:
            raise RecordingError(f"{self.path}: {problem}; `rtloop recover` keeps what is whole")
        for problems in (self.problems, self.left_out):
            if problem not in problems:
                problems.append(problem)


def tick_of(snapshot: Message) -> int:
    """The tick that a message of `/law` was taken at."""
    return int.from_bytes(snapshot.payload[DIGEST_BYTES : DIGEST_BYTES + 8], "little")


def _require_digest(snapshot: Message) -> None:
    digest, data = snapshot.payload[:DIGEST_BYTES], snapshot.payload[DIGEST_BYTES:]
    if hashlib.sha256(data).digest() != digest or len(data) < 8 or tick_of(snapshot) > LARGEST:
        raise Malformed("a snapshot of the law is damaged")
