"""Read a recording, finished or not, a chunk at a time, and report its faults.

Every returned value was under the checksum of its chunk, and a snapshot or configuration under a SHA-256 as
well. Data without a checksum (the headers of the file and of a chunk, the index of an unfinished file) only serves to
find chunks.
"""

from __future__ import annotations

import hashlib
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple, Self

from rtloop.foundation.arrays import Real
from rtloop.foundation.trusted import open_user_file
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.layout import open_layout
from rtloop.recording.file.mcap.chunks import ChunkEntry, McapSource, Opener
from rtloop.recording.file.mcap.container import DamagedChunk
from rtloop.recording.file.tick_account import TickAccount
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import (
    Message,
    may_hold,
    may_hold_slow,
    overlaps,
    split_messages,
    starts_with_tick,
)
from rtloop.recording.file.topics.events import FINAL, RECORDER, Event
from rtloop.recording.file.topics.overview import Intervals, OverviewLayout, Range, are_plausible, tick_ranges
from rtloop.recording.file.topics.ticks import LARGEST, TickLayout, Ticks
from rtloop.recording.file.topics.validation import MalformedText, parse_event

Rows = Real
ReadTicks = Callable[[], Ticks | None]
"""Function that returns the ticks of a chunk, or None for a chunk without ticks; it may raise DamagedChunk."""
WORKERS = 3
AHEAD = 16
"""Number of chunks that are decompressed ahead of the reader."""
DIGEST_BYTES = 32


class Snapshot(NamedTuple):
    """Snapshot of the law at the beginning of a tick: `data` starts with the tick, the bytes of the law follow."""

    tick: int
    data: bytes


class Reader:
    """Reader of a recording. If `tolerant`, damaged parts are skipped and listed in `problems` instead of raising.

    `left_out` lists the problems that removed data. `opener` opens the file:
    `open_user_file` of `rtloop.foundation.trusted` for one that a user named, another for one found in a folder.

    Opening the file, and every method that reads from it, can raise RecordingError.
    """

    def __init__(self, path: Path | str, *, tolerant: bool = False, opener: Opener = open_user_file) -> None:
        """Open a recording and read its header. Raises RecordingError if it is missing, no recording or malformed."""
        self.path, self.tolerant = Path(path), tolerant
        self._source = McapSource(self.path, opener)
        self.size_bytes: int = self._source.size
        """Size of the file in bytes."""
        try:
            self._source, self._layout = open_layout(self._source)
        except BaseException:
            self._source.close()
            raise
        self.header: format.Header = self._layout.header
        self.entries: list[ChunkEntry] = self._layout.entries
        """All chunks, in the order of the file."""
        self.problems = [*self._layout.problems]
        self.left_out = [*self._layout.left_out]
        self.columns: tuple[str, ...] = tuple(self.header["columns"])
        self._tick_layout, self._overview_layout = TickLayout(self.columns), OverviewLayout(self.columns)
        self.first_tick: int = self.header.get("first_tick", 0)
        self._end_of_repetition, self._end_tick = 0, round(LARGEST) + 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; a closed reader cannot read."""
        self._source.close()

    def restrict_begin(self, tick: int) -> None:
        """Let this file begin at `tick`, where the earlier files of the run end; `first_tick` becomes at least `tick`.

        Ticks, snapshots and events of the loop that this file repeats are skipped: all before `tick` and before
        `repeats_before` of the header. Any other tick before `tick` is a fault, found when the ticks are read.
        """
        self._end_of_repetition = min(self.header.get("repeats_before", 0), tick)
        self.first_tick = max(self.first_tick, tick)

    def restrict_end(self, tick: int) -> None:
        """Skip events of the loop and snapshots from `tick` on, which a later file holds as well; ticks stay."""
        self._end_tick = min(self._end_tick, tick)

    def owns(self, tick: int) -> bool:
        """Whether the loop's events and the snapshots of a tick are read from this file of the run."""
        return self._end_of_repetition <= tick < self._end_tick

    @property
    def repeated_ticks(self) -> int:
        """Number of leading ticks that are read from an earlier file of the run instead."""
        return max(self._end_of_repetition - self.header.get("first_tick", 0), 0)

    @cached_property
    def start_unix_ns(self) -> int:
        """Start of the run in UNIX ns: log time minus deadline of the first undamaged tick.

        Without such a tick, the time `created_unix_ns` of the header.
        """
        for entry in self.tick_chunks:
            try:
                content = self._layout.content(entry)
                if starts_with_tick(content):
                    return self._tick_layout.start_ns(content)
            except DamagedChunk:
                continue
        return int(self.header["created_unix_ns"])

    def chunk(self, entry: ChunkEntry) -> Ticks | list[Message] | None:
        """Ticks of a chunk, or the valid messages of a chunk without ticks; None for a damaged chunk.

        Data that another file of the run holds too is included. Damage is listed in `problems`, or raises
        RecordingError unless the reader is tolerant.
        """
        try:
            return self._parse(entry)
        except DamagedChunk as reason:
            self._report_chunk(entry, reason)
            return None

    @property
    def tick_chunks(self) -> list[ChunkEntry]:
        """The chunks that may hold ticks."""
        return [entry for entry in self.entries if may_hold(entry, format.TICKS)]

    def chunks_between(self, start_s: float, end_s: float) -> list[ChunkEntry] | None:
        """The chunks that may hold ticks due from `start_s` to `end_s` since the start, both included.

        None, which stands for all chunks, if `start_s` is at most 0 and `end_s` is infinite.
        """
        if start_s <= 0.0 and math.isinf(end_s):
            return None
        start_ns, end_ns = start_s * 1e9 + self.start_unix_ns, end_s * 1e9 + self.start_unix_ns
        return [entry for entry in self.tick_chunks if overlaps(entry, start_ns, end_ns)]

    def blocks(
        self, names: Sequence[str] | None = None, entries: Iterable[ChunkEntry] | None = None, *, ahead: bool = True
    ) -> Iterator[Rows]:
        """Yield arrays (n, names) float64 of the ticks, ascending; all columns in recorded order without `names`.

        Ticks may be missing between rows. Ticks that an earlier file of the run holds are left out. `entries` restricts
        the ticks to some of `tick_chunks`; without it, their number is compared with the recorder's. With `ahead`,
        threads decompress the next chunks; a process that shares its processors with others needs none. Damaged chunks
        are skipped; these and a wrong number of ticks are listed in `problems`, or raise RecordingError unless the
        reader is tolerant. Raises RecordingError for an unknown name.
        """
        columns = self._require_columns(self.columns if names is None else names)
        account = TickAccount(self.first_tick, self.totals, self._end_of_repetition)
        read = self._read_ahead if ahead else self._read_in_turn
        for entry, read_ticks in read(self.tick_chunks if entries is None else entries, columns):
            try:
                ticks = read_ticks()
                if ticks is not None and (ticks := account.add(ticks)) is not None:
                    yield ticks.rows
            except DamagedChunk as reason:
                self._report_chunk(entry, reason)
        if entries is None:
            self._check_count(account)

    def snapshots(self, before: int = -1) -> Iterator[Snapshot]:
        """Yield the law's snapshots by ascending tick, without snapshots that are read from another file of the run.

        A snapshot that contradicts its digest, or does not follow tick `before` and the snapshots so far, is left out
        and listed in `problems`; unless the reader is tolerant, it raises RecordingError.
        """
        for message in self._messages(format.LAW):
            tick, data = snapshot_tick(message), message.payload[DIGEST_BYTES:]
            if not self.owns(tick):
                continue
            if tick > before:
                yield Snapshot(tick, data)
            else:
                self._report(f"snapshots of the law are out of order: tick {tick} after tick {before}")
            before = max(before, tick)

    def chunks(self) -> Iterator[tuple[Rows | None, list[Message]]]:
        """Yield each chunk in the order of the file: (rows, []) for ticks, else (None, messages of the other topics).

        Data that another file of the run holds too is included. Damaged chunks, malformed messages and ticks out of
        order are left out; these and a wrong number of ticks are listed in `problems`, or raise RecordingError unless
        the reader is tolerant.
        """
        account = TickAccount(self.first_tick, self.totals)
        for entry in self.entries:
            try:
                content = self._parse(entry)
                if isinstance(content, Ticks):
                    account.add(content)
                    yield content.rows, []
                else:
                    yield None, content
            except DamagedChunk as reason:
                self._report_chunk(entry, reason)
        self._check_count(account)

    @property
    def events(self) -> list[Event]:
        """Events {tick, time_ns (since the start of the run), kind, who, axis, what} in the order of the file.

        Events of the loop that are read from another file of the run are left out. Damage is listed in `problems`, or
        raises RecordingError unless the reader is tolerant.
        """
        return [event for event in self._events if self._is_own(event)]

    @property
    def repeated_events(self) -> list[Event]:
        """Events of the loop that are read from another file of the run; see `events`."""
        return [event for event in self._events if not self._is_own(event)]

    def _is_own(self, event: Event) -> bool:
        """Whether an event is read from this file of the run."""
        return event["who"] == RECORDER or self.owns(event["tick"])

    @cached_property
    def _events(self) -> list[Event]:
        """All events in the file, repeated ones included."""
        return [parse_event(message.payload, self.header["axes"]) for message in self._messages(format.EVENTS)]

    @cached_property
    def overview(self) -> Intervals:
        """Intervals (n, columns, 3: minimum, maximum, mean) of the omitted ticks, by ascending tick.

        See `rtloop.recording.file.topics.overview`. Intervals without ticks, or with ticks of an earlier one, are left
        out and reported in `problems`; unless the reader is tolerant, they raise RecordingError.
        """
        intervals = self.overview_intervals(self._messages(format.OVERVIEW))
        is_plausible = are_plausible(intervals)
        if not is_plausible.all():
            self._report("an overview of omitted ticks covers no ticks, or ticks of an earlier overview")
        return intervals[is_plausible]

    def overview_intervals(self, messages: Iterable[Message]) -> Intervals:
        """Intervals (n, columns, 3: minimum, maximum, mean) of the overviews among valid `messages`.

        Messages of other topics are ignored.
        """
        return self._overview_layout.parse_intervals(
            [message.payload for message in messages if message.channel == format.OVERVIEW]
        )

    @cached_property
    def skipped_ranges(self) -> list[Range]:
        """Ranges (first tick, count) of the ticks omitted by intention, from `first_tick` on."""
        return [
            (max(first, self.first_tick), first + count - max(first, self.first_tick))
            for first, count in tick_ranges(self.overview)
            if first + count > self.first_tick
        ]

    @property
    def totals(self) -> format.Totals | None:
        """Totals that the recorder stored when it finished the file; None for an unfinished file.

        Keys: ticks_executed, ticks_logged, ticks_lost, events_lost, result, complete, and further ones in some files.
        """
        final_events = [event for event in self._events if event["kind"] in FINAL]
        return final_events[-1]["what"] if final_events else None

    def _require_columns(self, names: Sequence[str]) -> Sequence[str]:
        """Return `names`. Raises RecordingError for a name that is no column."""
        unknown = [name for name in names if name not in self.columns]
        if unknown:
            raise RecordingError(f"{self.path}: no signal {unknown[0]!r}; allowed: {', '.join(self.columns)}")
        return names

    def _parse(self, entry: ChunkEntry) -> Ticks | list[Message]:
        """Return the ticks of a chunk, or its valid messages of other topics; invalid ones are reported.

        Raises DamagedChunk if the chunk is damaged, RecordingError for an invalid message unless the reader is
        tolerant.
        """
        content = self._layout.content(entry)
        if starts_with_tick(content):
            return self._tick_layout.parse_ticks(content, self.columns)
        return self._valid_messages(split_messages(content))

    def _read_ahead(
        self, entries: Iterable[ChunkEntry], names: Sequence[str]
    ) -> Iterator[tuple[ChunkEntry, ReadTicks]]:
        """Yield each entry with a function that returns its ticks with columns `names`, read ahead in threads.

        The function returns None for a chunk of other messages, and raises DamagedChunk.
        """
        queue: deque[tuple[ChunkEntry, ReadTicks]] = deque()
        with ThreadPoolExecutor(WORKERS) as pool:
            for entry in entries:
                queue.append((entry, pool.submit(self._read_ticks, entry, names).result))
                if len(queue) >= AHEAD:
                    yield queue.popleft()
            while queue:
                yield queue.popleft()

    def _read_in_turn(
        self, entries: Iterable[ChunkEntry], names: Sequence[str]
    ) -> Iterator[tuple[ChunkEntry, ReadTicks]]:
        """Yield each entry with a function that reads and returns columns `names` of its ticks when it is called.

        The function returns None for a chunk of other messages, and raises DamagedChunk.
        """
        for entry in entries:
            yield entry, partial(self._read_ticks, entry, names)

    def _read_ticks(self, entry: ChunkEntry, names: Sequence[str]) -> Ticks | None:
        """Return columns `names` of the ticks of a chunk; None if it holds messages of other topics.

        Raises DamagedChunk if the chunk is damaged.
        """
        content = self._layout.content(entry)
        return self._tick_layout.parse_ticks(content, names) if starts_with_tick(content) else None

    def _messages(self, channel: int) -> Iterator[Message]:
        """Yield the valid messages of a topic other than /ticks, by its channel id, in the order of the file.

        Damaged chunks, and invalid messages of any topic in the same chunks, are listed in `problems`, or raise
        RecordingError unless the reader is tolerant.
        """
        for entry in self.entries:
            if may_hold_slow(entry, channel):
                yield from (message for message in self._slow_messages(entry) if message.channel == channel)

    def _slow_messages(self, entry: ChunkEntry) -> list[Message]:
        """Return the valid messages of a chunk; [] if it holds ticks or is damaged.

        Damage is listed in `problems`, or raises RecordingError unless the reader is tolerant.
        """
        try:
            content = self._layout.content(entry)
            return [] if starts_with_tick(content) else self._valid_messages(split_messages(content))
        except DamagedChunk as reason:
            self._report_chunk(entry, reason)
            return []

    def _valid_messages(self, messages: list[Message]) -> list[Message]:
        """Return the valid ones of `messages`; the faults of the others are listed in `problems`.

        Raises RecordingError for an invalid message unless the reader is tolerant.
        """
        valid = []
        for message in messages:
            try:
                if message.channel == format.EVENTS:
                    parse_event(message.payload, self.header["axes"])
                elif message.channel == format.LAW:
                    _require_digest(message)
                elif message.channel == format.OVERVIEW:
                    self._overview_layout.require_overview(message.payload)
                elif message.channel != format.CONFIGURATION:
                    raise MalformedText(f"a message of channel {message.channel} is none of the recording's topics")
                valid.append(message)
            except ValueError as reason:
                is_event = message.channel == format.EVENTS
                self._report(f"an event is malformed: {reason}" if is_event else str(reason))
        return valid

    def _report_chunk(self, entry: ChunkEntry, reason: DamagedChunk) -> None:
        """List a damaged chunk, by its offset, in `problems`; raise RecordingError unless the reader is tolerant."""
        self._report(f"the chunk at byte {entry.offset} is damaged ({reason})")

    def _check_count(self, account: TickAccount) -> None:
        """List a number of ticks that differs from the recorder's in `problems`, unless data is left out anyway.

        Raises RecordingError for it unless the reader is tolerant.
        """
        if account.shortage_problem and not self.left_out:
            self._report(account.shortage_problem)

    def _report(self, problem: str) -> None:
        """Add a problem that removed data to `problems` and `left_out`, once.

        Raises RecordingError instead unless the reader is tolerant.
        """
        if not self.tolerant:
            raise RecordingError(f"{self.path}: {problem}; `rtloop recover` keeps the undamaged part")
        for problems in (self.problems, self.left_out):
            if problem not in problems:
                problems.append(problem)


def snapshot_tick(snapshot: Message) -> int:
    """Tick at which the snapshot in a message of `/law` was taken."""
    return int.from_bytes(snapshot.payload[DIGEST_BYTES : DIGEST_BYTES + 8], "little")


def _require_digest(snapshot: Message) -> None:
    """Raise MalformedText unless a message of `/law` agrees with its SHA-256 and has a tick, at most LARGEST."""
    digest, data = snapshot.payload[:DIGEST_BYTES], snapshot.payload[DIGEST_BYTES:]
    if hashlib.sha256(data).digest() != digest or len(data) < 8 or snapshot_tick(snapshot) > LARGEST:
        raise MalformedText("a snapshot of the law is damaged")
