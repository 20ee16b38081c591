"""Read the messages of any MCAP file with the package `mcap`, in memory that does not depend on lengths in the file."""

from __future__ import annotations

import io
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, DataEnd, Header, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from rtloop.recording.file.mcap.chunks import McapSource
from rtloop.recording.file.mcap.container import DamagedChunk

LARGEST_BYTES = 32 << 20
"""Maximum size of a record, and of the content of a chunk."""
WINDOW_BYTES = 1 << 16
MAX_TOPICS, MAX_CHARACTERS = 12, 60
"""Maximum number of topics in a description, and of characters of a name."""
UNREADABLE = (McapError, struct.error, ValueError, KeyError, RuntimeError, EOFError, MemoryError, OverflowError)
"""Exceptions that the stock reader, zstandard and lz4 raise for damaged bytes."""

Item = tuple[Schema | None, Channel, Message]


def read_messages(source: McapSource) -> Iterator[Item]:
    """Yield (schema or None, channel, message) for every message, in the order of the file.

    Raises DamagedChunk if the rest is unreadable, RecordingError if the system cannot read the file.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    try:
        for record in _records(source):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                yield schemas.get(channel.schema_id), channel, record
    except UNREADABLE as error:
        raise DamagedChunk(f"damaged ({type(error).__name__})") from None


def library_name(source: McapSource) -> str:
    """Name of the library that wrote the file, from the file's header; "" if the header is unreadable."""
    try:
        header = next(_records(source), None)
    except (*UNREADABLE, DamagedChunk):
        return ""
    return header.library if isinstance(header, Header) else ""


def encoding(channel: Channel, schema: Schema | None) -> str:
    """Return the encoding of a channel's messages as text, or "unnamed encoding".

    The schema's encoding follows in brackets, unless it is the same or the usual one for it (`jsonschema` for `json`).
    """
    name = schema.encoding if schema else ""
    is_implied = name in ("", channel.message_encoding, f"{channel.message_encoding}schema")
    return (channel.message_encoding or "unnamed encoding") + ("" if is_implied else f" ({name})")


def describe_topics(counts: Counter[tuple[str, str]]) -> str:
    """List the MAX_TOPICS most frequent topics, encoding and number of messages, as text; "no message" without any.

    `counts` has the number of messages by (topic, encoding).
    """
    topics = [
        f"{topic[:MAX_CHARACTERS]!r} ({words}, {count} messages)"
        for (topic, words), count in counts.most_common(MAX_TOPICS)
    ]
    return ", ".join(topics) + (", …" if len(counts) > MAX_TOPICS else "") or "no message"


def _records(source: McapSource) -> Iterator[McapRecord]:
    """Yield the records of the data section; for a chunk, yield the records inside it instead.

    Raises DamagedChunk, or one of UNREADABLE, for damaged, oversized or unknown data.
    """
    reader = StreamReader(_Stream(source), emit_chunks=True, validate_crcs=True)  # type: ignore[arg-type]
    for record in reader.records:
        if isinstance(record, DataEnd):
            return
        if isinstance(record, Chunk):
            yield from breakup_chunk(_decompress(record), validate_crc=True)
        else:
            yield record


def _decompress(chunk: Chunk) -> Chunk:
    """Return the chunk without compression; the stock reader would allocate as much memory as the file asks for.

    Raises DamagedChunk for a content above LARGEST_BYTES, a wrong size, damaged data, or a compression other than zstd
    and lz4.
    """
    size = chunk.uncompressed_size
    if size > LARGEST_BYTES:
        raise DamagedChunk(f"a chunk has {size} bytes; allowed: up to {LARGEST_BYTES >> 20} MiB")
    if chunk.compression == "zstd":
        decompressor = zstandard.ZstdDecompressor(max_window_size=LARGEST_BYTES)
        try:
            data = decompressor.stream_reader(chunk.data, read_across_frames=True).read(size + 1)
        except zstandard.ZstdError:
            raise DamagedChunk("a chunk cannot be decompressed") from None
    elif chunk.compression == "lz4":
        try:
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        except RuntimeError:
            raise DamagedChunk("a chunk cannot be decompressed") from None
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise DamagedChunk(
            f"a chunk is compressed with {chunk.compression[:MAX_CHARACTERS]!r}; allowed: zstd, lz4, none"
        )
    if len(data) != size:
        raise DamagedChunk(f"a chunk has {len(data)} bytes, but the header of the chunk says {size} bytes")
    return replace(chunk, compression="", data=data)


class _Stream:
    """Stream of a file for the stock reader, from its beginning on."""

    def __init__(self, source: McapSource) -> None:
        """Begin at the first byte of `source`, without reading it."""
        self._source, self._begin = source, 0
        self._window = io.BytesIO()

    def read(self, length: int) -> bytes:
        """Read exactly `length` bytes. Raises DamagedChunk for more than LARGEST_BYTES, or than are left."""
        if length > LARGEST_BYTES:
            raise DamagedChunk(f"a record has {length} bytes; allowed: up to {LARGEST_BYTES >> 20} MiB")
        data = self._window.read(length)
        if len(data) < length:
            self._begin += self._window.tell() - len(data)
            self._window = io.BytesIO(self._source.read(self._begin, max(length, WINDOW_BYTES)))
            data = self._window.read(length)
        if len(data) < length:
            raise DamagedChunk("the file ends in the middle of a record")
        return data
