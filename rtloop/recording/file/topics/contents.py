"""Contents of a chunk: either ticks alone, or messages of the slow topics, which are all topics but /ticks."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode

from rtloop.foundation.trusted import open_without_link
from rtloop.recording.file.mcap.chunks import ChunkEntry, McapSource, require_message_indexes, scan_chunks
from rtloop.recording.file.mcap.container import (
    MESSAGE_HEAD,
    PREFIX,
    DamagedChunk,
    parse_chunk_head,
    split_records,
    unpack_chunk,
)
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.events import Event


class Message(NamedTuple):
    """Message of a topic other than /ticks: channel id, log time in ns since the UNIX epoch, and payload."""

    channel: int
    log_time: int
    payload: bytes


def event_message(event: Event, start_unix_ns: int) -> Message:
    """Return an event as a message; log time = `start_unix_ns` + the event's time since the start of the run."""
    return Message(format.EVENTS, start_unix_ns + event["time_ns"], json.dumps(event).encode())


def may_hold_slow(entry: ChunkEntry, channel: int) -> bool:
    """Whether a chunk may hold messages of topic `channel`, which is not /ticks; True without an index.

    If `channel` is events, snapshots or header, the result is True for a chunk with messages of any of these three.
    """
    if entry.index is None or channel == format.OVERVIEW:
        return may_hold(entry, channel)
    return any(other_channel not in (format.TICKS, format.OVERVIEW) for other_channel in entry.index.channels)


def may_hold(entry: ChunkEntry, channel: int) -> bool:
    """Whether a chunk may hold messages of a channel; True without an index.

    The index names the channels of a chunk; a chunk without named channels counts as one of ticks.
    """
    if entry.index is None:
        return True
    return channel in (entry.index.channels or (format.TICKS,))


def overlaps(entry: ChunkEntry, start_ns: float, end_ns: float) -> bool:
    """Whether a chunk may hold messages between two log times (UNIX ns), both included; True without an index.

    A chunk up to 1 µs outside counts too, because a double of such a time is not more exact.
    """
    index, margin_ns = entry.index, 1e3
    return index is None or not (index.end < start_ns - margin_ns or index.start > end_ns + margin_ns)


def read_chunk(source: McapSource, entry: ChunkEntry) -> bytes:
    """Return a chunk record of the file, still compressed.

    Raises DamagedChunk if its beginning is damaged or contradicts the index, which has a checksum, or if other data
    than message indexes follows it; without an index entry neither is checked. Raises RecordingError if the file cannot
    be read.
    """
    record = source.read(entry.offset, entry.length)
    if entry.index:
        head = parse_chunk_head(record)
        if (head.start, head.end, head.uncompressed) != (entry.index.start, entry.index.end, entry.index.uncompressed):
            raise DamagedChunk(
                "the header of a data block is damaged: its times or its size differ from the file's index"
            )
        require_message_indexes(source, entry)
    return record


def chunk_contents_from(path: Path, position: int) -> Iterator[bytes]:
    """Yield the unpacked contents of the undamaged chunks from byte `position` of a file on.

    Raises RecordingError if the file is a link, cannot be opened or is no MCAP file.
    """
    with closing(McapSource(path, open_without_link)) as source:
        for entry in scan_chunks(source, position)[0]:
            with suppress(DamagedChunk):
                yield unpack_chunk(read_chunk(source, entry))


def starts_with_tick(content: bytes) -> bool:
    """Whether an unpacked chunk begins with a tick; such a chunk holds only ticks."""
    return content[:1] == bytes([Opcode.MESSAGE]) and _channel(content[PREFIX.size :]) == format.TICKS


def accounts_for_ticks(content: bytes) -> bool:
    """Whether an unpacked chunk holds ticks or the overview of omitted ticks. Raises DamagedChunk if it is cut off."""
    return starts_with_tick(content) or any(message.channel == format.OVERVIEW for message in split_messages(content))


def split_messages(content: bytes) -> list[Message]:
    """Split an unpacked chunk without ticks into its messages.

    Raises DamagedChunk for a cut-off record, and one that no chunk may hold.
    """
    head, records = MESSAGE_HEAD.size - PREFIX.size, list(split_records(content))
    if unknown := {opcode for opcode, _ in records} - {Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL}:
        raise DamagedChunk(f"contains a record of type {min(unknown)}; allowed: messages, schemas and channels")
    return [
        Message(_channel(record), int.from_bytes(record[6:14], "little"), record[head:])
        for opcode, record in records
        if opcode == Opcode.MESSAGE
    ]


def _channel(record: bytes) -> int:
    """Channel id of a message record without its prefix."""
    return int.from_bytes(record[:2], "little")
