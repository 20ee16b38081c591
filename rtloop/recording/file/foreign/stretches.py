"""Any MCAP file, gone through from its beginning to its data end: what a valid one holds, however it is laid out.

The data section is taken in stretches of consecutive records, each read for itself in bounded memory. Summary and
indexes are not looked at: they may be absent, and say nothing that the data does not. A length is held against the
file before anything of that length is read.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Schema

from rtloop.recording.file.foreign.container import HEAD, LARGEST_BYTES, record_length, said_size, unpack
from rtloop.recording.file.mcap.chunks import Source
from rtloop.recording.file.mcap.container import MAGIC, MESSAGE_HEAD, PREFIX, DamagedChunk

STRETCH_BYTES = 1 << 20
"""Uncompressed; a single record may be larger."""
WINDOW_BYTES = 1 << 16
CONTENT = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK}
FEW_ROWS = 16
_KEY = 11
"""Opcode, length and channel: equal in all messages of a run."""


class Stretch(NamedTuple):
    """Consecutive records of a file: where they begin, how long they are in it, and unpacked, in bytes."""

    offset: int
    length: int
    size: int


class Run(NamedTuple):
    """Messages of one channel that follow each other and are equally long: their records, uint8 of (n, length)."""

    channel: int
    records: np.ndarray[tuple[int, int], np.dtype[np.uint8]]

    @property
    def log_times(self) -> np.ndarray[tuple[int], np.dtype[np.uint64]]:
        """(n,) in ns since the UNIX epoch."""
        return np.ascontiguousarray(self.records[:, 15:23]).view("<u8")[:, 0]

    @property
    def payloads(self) -> Iterator[bytes]:
        """What each message says."""
        return (record[MESSAGE_HEAD.size :].tobytes() for record in self.records)


class Topics:
    """The schemas and channels of a file, by their ids, as far as it was read."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}

    def note(self, opcode: int, content: memoryview) -> None:
        """A record of either. Raises DamagedChunk for one that cannot be read, or says another thing of the same id."""
        kind, known = (Schema, self.schemas) if opcode == Opcode.SCHEMA else (Channel, self.channels)
        try:
            found = kind.read(ReadDataStream(io.BytesIO(content)))
        except (struct.error, ValueError, McapError, MemoryError, OverflowError):
            raise DamagedChunk(f"a {kind.__name__.lower()} cannot be read") from None
        if known.setdefault(found.id, found) != found:  # type: ignore[arg-type]
            raise DamagedChunk(f"{kind.__name__.lower()} {found.id} is two things")

    def schema_of(self, channel: int) -> Schema | None:
        """Of a channel; None where it names none, or one that is not there."""
        return self.schemas.get(self.channels[channel].schema_id)


def library(source: Source) -> str:
    """What the file says of who wrote it; empty where that cannot be read."""
    head = source.read(len(MAGIC), 1 << 12)
    try:
        opcode, length = PREFIX.unpack_from(head)
        if opcode != Opcode.HEADER or PREFIX.size + length > len(head):
            return ""
        return Header.read(ReadDataStream(io.BytesIO(head[PREFIX.size : PREFIX.size + length]))).library
    except (struct.error, ValueError, McapError):
        return ""


def stretches(source: Source) -> tuple[list[Stretch], list[str]]:
    """All of a file that may hold messages, and why some of it is left out."""
    found: list[Stretch] = []
    problems: list[str] = []
    position = len(MAGIC)
    window, begin = b"", 0
    while True:
        at = position - begin
        if at + HEAD.size > len(window):
            window, begin, at = source.read(position, WINDOW_BYTES), position, 0
        opcode = window[at] if at < len(window) else None
        if opcode == Opcode.DATA_END:
            return found, problems
        length = record_length(window, at) if at + PREFIX.size <= len(window) else source.size
        if position + length > source.size:
            if position < source.size:
                problems.append(f"it ends in the middle of a record: {source.size - position} bytes are left out")
            return found, problems
        if opcode in CONTENT:
            whole = length >= HEAD.size and at + HEAD.size <= len(window)
            size = length + (said_size(window[at : at + HEAD.size]) if opcode == Opcode.CHUNK and whole else 0)
            if length > LARGEST_BYTES or size - length > LARGEST_BYTES:
                size, most = max(length, size - length), LARGEST_BYTES >> 20
                problems.append(f"the record at byte {position} has {size} bytes; at most {most} MiB can be read")
            else:
                _add(found, Stretch(position, length, size))
        position += length


def _add(found: list[Stretch], new: Stretch) -> None:
    """To the last stretch, with what else lies between, unless that becomes too large."""
    last = found[-1] if found else Stretch(0, 0, STRETCH_BYTES)
    between = new.offset - last.offset - last.length
    if last.size + between + new.size <= STRETCH_BYTES:
        found[-1] = Stretch(last.offset, last.length + between + new.length, last.size + between + new.size)
    else:
        found.append(new)


def halves(source: Source, stretch: Stretch) -> list[Stretch]:
    """The same records in two stretches; none where it is a single one."""
    data, position, places = source.read(stretch.offset, stretch.length), 0, []
    while position + PREFIX.size <= len(data):
        places.append(position)
        position += record_length(data, position)
    if len(places) < 2:
        return []
    cut = places[len(places) // 2]
    return [
        Stretch(stretch.offset, cut, stretch.size),
        Stretch(stretch.offset + cut, stretch.length - cut, stretch.size),
    ]


def contents(source: Source, stretch: Stretch) -> Iterator[memoryview]:
    """Records, one after the other, some at a time; those of a chunk instead of it. Raises DamagedChunk."""
    data = memoryview(source.read(stretch.offset, stretch.length))
    if len(data) != stretch.length:
        raise DamagedChunk("cut off")
    begin = position = 0
    while position < len(data):
        end = position + record_length(data, position)
        if data[position] == Opcode.CHUNK:
            if begin < position:
                yield data[begin:position]
            yield unpack(data[position:end])
            begin = end
        position = end
    if begin < position:
        yield data[begin:]


def runs(records: memoryview, topics: Topics) -> Iterator[Run]:
    """The messages among `records`, in order; schemas and channels are noted. Raises DamagedChunk."""
    position = 0
    while position < len(records):
        if position + PREFIX.size > len(records):
            raise DamagedChunk("a record is cut off")
        opcode, length = records[position], record_length(records, position)
        if position + length > len(records):
            raise DamagedChunk("a record is cut off")
        if opcode == Opcode.MESSAGE:
            if length < MESSAGE_HEAD.size:
                raise DamagedChunk("a message is cut off")
            run = _run(records[position:], length)
            if run.channel not in topics.channels:
                raise DamagedChunk(f"a message of channel {run.channel}, which was not declared")
            yield run
            length *= len(run.records)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            topics.note(opcode, records[position + PREFIX.size : position + length])
        position += length


def _run(records: memoryview, length: int) -> Run:
    """As many messages like the first as follow each other."""
    most = len(records) // length
    rows = np.frombuffer(records, np.uint8, most * length).reshape(most, length)
    count, step = 1, FEW_ROWS
    if records[:_KEY] != records[length : length + _KEY]:  # the usual case where lengths differ, and many times as fast
        most = 1
    while count < most:
        same = (rows[count : count + step, :_KEY] == rows[0, :_KEY]).all(axis=1)
        if not same.all():
            count += int(np.argmin(same))
            break
        count, step = count + len(same), step * 4
    return Run(int.from_bytes(records[9:11], "little"), rows[:count])
