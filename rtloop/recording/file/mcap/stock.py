"""Messages of any MCAP file, by the reader of the package `mcap`, in memory that no length in the file decides."""

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
"""Of a record, and of a chunk's content."""
WINDOW_BYTES = 1 << 16
MOST_SHOWN, SHOWN = 12, 60
"""Topics in a description, and characters of a name."""
UNREADABLE = (McapError, struct.error, ValueError, KeyError, RuntimeError, EOFError, MemoryError, OverflowError)
"""What the stock reader, zstandard and lz4 raise at damaged bytes."""

Item = tuple[Schema | None, Channel, Message]


def read_messages(source: McapSource) -> Iterator[Item]:
    """Yield all messages in the order of the file. Raises DamagedChunk where the rest cannot be read."""
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
        raise DamagedChunk(f"it is damaged ({type(error).__name__})") from None


def library(source: McapSource) -> str:
    """The name of the library that wrote the file, by the file's header; empty where that cannot be read."""
    try:
        header = next(_records(source), None)
    except (*UNREADABLE, DamagedChunk):
        return ""
    return header.library if isinstance(header, Header) else ""


def encoding(channel: Channel, schema: Schema | None) -> str:
    """The encoding of a channel's messages, in words."""
    described = schema.encoding if schema else ""
    same = described in ("", channel.message_encoding, f"{channel.message_encoding}schema")
    return (channel.message_encoding or "of no encoding") + ("" if same else f" ({described})")


def described(counts: Counter[tuple[str, str]]) -> str:
    """Topics in words, from the number of messages by topic and encoding."""
    shown = [
        f"{topic[:SHOWN]!r} ({words}, {count} messages)" for (topic, words), count in counts.most_common(MOST_SHOWN)
    ]
    return ", ".join(shown) + (", …" if len(counts) > MOST_SHOWN else "") or "no message"


def _records(source: McapSource) -> Iterator[McapRecord]:
    """Yield the records of the data section, those of a chunk in its place. Raises DamagedChunk, UNREADABLE."""
    reader = StreamReader(_Stream(source), emit_chunks=True, validate_crcs=True)  # type: ignore[arg-type]
    for record in reader.records:
        if isinstance(record, DataEnd):
            return
        if isinstance(record, Chunk):
            yield from breakup_chunk(_unpacked(record), validate_crc=True)
        else:
            yield record


def _unpacked(chunk: Chunk) -> Chunk:
    """The same chunk without compression; the stock reader would take as much memory as the file says."""
    size = chunk.uncompressed_size
    if size > LARGEST_BYTES:
        raise DamagedChunk(f"a chunk has {size} bytes; allowed: {LARGEST_BYTES >> 20} MiB")
    if chunk.compression == "zstd":
        decompressor = zstandard.ZstdDecompressor(max_window_size=LARGEST_BYTES)
        try:
            data = decompressor.stream_reader(chunk.data, read_across_frames=True).read(size + 1)
        except zstandard.ZstdError:
            raise DamagedChunk("a chunk cannot be decompressed") from None
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise DamagedChunk(f"a chunk is compressed by {chunk.compression[:SHOWN]!r}; allowed: zstd, lz4 or none")
    if len(data) != size:
        raise DamagedChunk(f"a chunk has {len(data)} bytes and names {size}")
    return replace(chunk, compression="", data=data)


class _Stream:
    """A file for the stock reader, from its beginning on."""

    def __init__(self, source: McapSource) -> None:
        self._source, self._begin = source, 0
        self._window = io.BytesIO()

    def read(self, length: int) -> bytes:
        """Read exactly `length` bytes. Raises DamagedChunk for more than may be read at once, or than there are."""
        if length > LARGEST_BYTES:
            raise DamagedChunk(f"a record has {length} bytes; allowed: {LARGEST_BYTES >> 20} MiB")
        data = self._window.read(length)
        if len(data) < length:
            self._begin += self._window.tell() - len(data)
            self._window = io.BytesIO(self._source.read(self._begin, max(length, WINDOW_BYTES)))
            data = self._window.read(length)
        if len(data) < length:
            raise DamagedChunk("it ends in the middle of a record")
        return data
