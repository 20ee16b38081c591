"""Reads a recording, finished or not, a chunk at a time, and says what is missing from it.

Every value that is handed out was under a checksum: that of its chunk, and for snapshots and the configuration a
SHA-256 as well. What has no checksum (the header of the file and of a chunk, the index of an unfinished file) is used
to find chunks only.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from rtloop.recording import format
from rtloop.recording.chunks import Entry, Source, indexed_chunks, scanned_chunks
from rtloop.recording.container import DamagedChunk, unpack_chunk
from rtloop.recording.contents import Message, is_ticks, may_hold, overlaps, read_chunk, split_messages, tick_rows
from rtloop.recording.errors import RecordingError
from rtloop.recording.events import FINAL, Event
from rtloop.recording.header import read_header
from rtloop.signals import DEADLINE

Rows = np.ndarray[Any, Any]
WORKERS = 3
AHEAD = 16
"""Chunks that are decompressed beyond the one that is asked for."""


class Snapshot(NamedTuple):
    """The law at the beginning of a tick: the bytes after the tick's number are the law's own."""

    tick: int
    data: bytes


class Reader:
    """An open recording. `tolerant`: damaged chunks are left out and named in `problems` instead of raising.

    Raises RecordingError, here and while reading.
    """

    def __init__(self, path: Path | str, *, tolerant: bool = False) -> None:
        self.path, self.tolerant = Path(path), tolerant
        self.problems: list[str] = []
        self._source = Source(self.path)
        try:
            self._entries = self._find_chunks()
            self.header = read_header(self.path, self._source, self._entries)
        except BaseException:
            self._source.close()
            raise
        self.columns: tuple[str, ...] = tuple(self.header["columns"])
        self._dtype = format.tick_dtype(self.columns)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return self._source.size

    @cached_property
    def start_unix_ns(self) -> int:
        """When the run started: log time minus deadline of the first tick; the header's time if there is none."""
        for entry in self.tick_chunks:
            try:
                content = self._content(entry)
            except DamagedChunk:
                continue
            if is_ticks(content):
                first = np.frombuffer(content, self._dtype, count=1)
                return int(first["_log_time"][0]) - int(first[self.columns[DEADLINE]][0])
        return int(self.header["created_unix_ns"])

    @property
    def tick_chunks(self) -> list[Entry]:
        """The chunks that may hold ticks."""
        return [entry for entry in self._entries if may_hold(entry, format.TICKS)]

    def chunks_between(self, start_s: float, end_s: float) -> list[Entry]:
        """The chunks that may hold ticks due between two times, in s since the start of the run."""
        if start_s <= 0.0 and math.isinf(end_s):
            return self.tick_chunks
        start_ns, end_ns = start_s * 1e9 + self.start_unix_ns, end_s * 1e9 + self.start_unix_ns
        return [entry for entry in self.tick_chunks if overlaps(entry, start_ns, end_ns)]

    def blocks(self, names: Sequence[str] | None = None, entries: Iterable[Entry] | None = None) -> Iterator[Rows]:
        """Arrays (n, columns) float64 of consecutive ticks in order; only the columns `names`, if given.

        `entries` restricts it to some of `tick_chunks`. Decompression runs ahead in threads.
        """
        wanted = self._known(self.columns if names is None else names)
        waiting: deque[tuple[Entry, Future[Rows | None]]] = deque()
        with ThreadPoolExecutor(WORKERS) as pool:
            for entry in self.tick_chunks if entries is None else entries:
                waiting.append((entry, pool.submit(self._rows_of, entry, wanted)))
                if len(waiting) >= AHEAD:
                    yield from self._ready(*waiting.popleft())
            while waiting:
                yield from self._ready(*waiting.popleft())

    def snapshots(self) -> Iterator[Snapshot]:
        """The snapshots of the law, in order, each verified by its digest."""
        for message in self._messages(format.LAW):
            digest, data = message.payload[:32], message.payload[32:]
            if hashlib.sha256(data).digest() != digest:
                self._report("a snapshot of the law is damaged")
                continue
            yield Snapshot(int.from_bytes(data[:8], "little"), data)

    def chunks(self) -> Iterator[tuple[Rows | None, list[Message]]]:
        """Each chunk in the order of the file: either its ticks or its messages of the slow topics."""
        for entry in self._entries:
            try:
                content = self._content(entry)
                if is_ticks(content):
                    yield tick_rows(content, self._dtype, self.columns), []
                else:
                    yield None, split_messages(content)
            except DamagedChunk as reason:
                self._report(f"the chunk at byte {entry.offset} is damaged ({reason})")

    @cached_property
    def events(self) -> list[Event]:
        """The events, in the order of the file."""
        return [json.loads(message.payload) for message in self._messages(format.EVENTS)]

    @property
    def totals(self) -> dict[str, Any] | None:
        """What the recorder counted when it finished the file; None where it did not."""
        last = [event for event in self.events if event["kind"] in FINAL]
        return last[-1]["what"] if last else None

    def _known(self, names: Sequence[str]) -> Sequence[str]:
        unknown = [name for name in names if name not in self.columns]
        if unknown:
            raise RecordingError(f"{self.path}: no signal {unknown[0]!r}; there are {', '.join(self.columns)}")
        return names

    def _find_chunks(self) -> list[Entry]:
        try:
            return indexed_chunks(self._source)
        except DamagedChunk as reason:
            entries, problems = scanned_chunks(self._source)
            self.problems += [f"{reason}: read from the beginning, without its index", *problems]
            return entries

    def _content(self, entry: Entry) -> bytes:
        return unpack_chunk(read_chunk(self._source, entry))

    def _rows_of(self, entry: Entry, names: Sequence[str]) -> Rows | None:
        """The ticks of a chunk; None if it holds something else. Raises DamagedChunk."""
        content = self._content(entry)
        return tick_rows(content, self._dtype, names) if is_ticks(content) else None

    def _ready(self, entry: Entry, future: Future[Rows | None]) -> Iterator[Rows]:
        try:
            rows = future.result()
        except DamagedChunk as reason:
            self._report(f"the chunk at byte {entry.offset} is damaged ({reason})")
            return
        if rows is not None:
            yield rows

    def _messages(self, channel: int) -> Iterator[Message]:
        """The messages of one of the slow topics."""
        for entry in self._entries:
            if may_hold(entry, channel):
                yield from (message for message in self._slow(entry) if message.channel == channel)

    def _slow(self, entry: Entry) -> list[Message]:
        """The messages of the slow topics in a chunk."""
        try:
            content = self._content(entry)
            return [] if is_ticks(content) else split_messages(content)
        except DamagedChunk as reason:
            self._report(f"the chunk at byte {entry.offset} is damaged ({reason})")
            return []

    def _report(self, problem: str) -> None:
        if not self.tolerant:
            raise RecordingError(f"{self.path}: {problem}; `rtloop recover` keeps what is whole")
        if problem not in self.problems:
            self.problems.append(problem)
