"""Pack and parse the bytes of an MCAP container: chunk records and the summary section, whatever they contain.

Layout of a file (https://mcap.dev/spec): magic, header, chunks, data end, summary, footer, magic. Only three parts
have a checksum: the content of a chunk, the summary section, and (in a finished file) the data section as a whole.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    DataEnd,
    Footer,
    McapRecord,
    Statistics,
    SummaryOffset,
)

from rtloop.recording.file.mcap.checksum import crc32

MAGIC = b"\x89MCAP0\r\n"
PREFIX = struct.Struct("<BQ")
CHUNK_HEAD = struct.Struct("<BQQQQII4sQ")
CHUNK_INDEX_HEAD = struct.Struct("<BQQQQ")
INDEX_BEGIN, INDEX_PLACE = struct.Struct("<QQQQI"), struct.Struct("<HQ")
INDEX_NAME, INDEX_SIZES = struct.Struct("<QI"), struct.Struct("<QQ")
"""Content of a chunk index record: first and last log time, offset and length of the chunk, bytes of the places that
follow; places, each a channel and the offset of its message index; length of the message indexes, length of the name
of the compression, the name; compressed and uncompressed size."""
CHUNK_MARK = struct.pack("<I4s", 4, b"zstd")
"""Name of the compression inside every chunk record, by which a scan finds chunks."""
CHUNK_MARK_OFFSET = 37
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
FOOTER_HEAD = struct.Struct("<BQQQ")
FOOTER_BYTES = FOOTER_HEAD.size + 4
DATA_END_BYTES = PREFIX.size + 4
LARGEST_CHUNK_BYTES = 16 << 20
"""Largest uncompressed size; a larger chunk counts as damaged and is not allocated."""


class _Decompressors(threading.local):
    """The decompressor of each thread, `of_thread`, which all its chunks share: to make one takes as long as a chunk
    of messages."""

    def __init__(self) -> None:
        """Make the decompressor of a thread, at its first use there."""
        self.of_thread = zstandard.ZstdDecompressor()


_decompressors = _Decompressors()


class DamagedChunk(Exception):
    """A damaged chunk or record; the message gives the fault."""


class ChunkHead(NamedTuple):
    """Fixed fields of a chunk record; times in ns since the UNIX epoch, sizes in bytes."""

    start: int
    end: int
    uncompressed: int
    crc: int
    compressed: int


class IndexedChunk(NamedTuple):
    """A chunk as the index of its file describes it: 300 bytes of memory, for a day has 200,000 of them.

    `offset`, `length`, `index_length` (of the message indexes behind it) and `uncompressed` are in bytes; `start` and
    `end` are the first and the last log time in ns since the UNIX epoch; `channels` are the ids in the message indexes.
    """

    offset: int
    length: int
    index_length: int
    start: int
    end: int
    uncompressed: int
    channels: tuple[int, ...]


def pack_message(channel: int, log_time: int, payload: bytes) -> bytes:
    """Pack a message record; `log_time` in ns since the UNIX epoch."""
    length = MESSAGE_HEAD.size - PREFIX.size + len(payload)
    return MESSAGE_HEAD.pack(Opcode.MESSAGE, length, channel, 0, log_time, log_time) + payload


def pack_records(records: Iterable[McapRecord]) -> bytes:
    """Pack records, one after the other."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def pack_chunk(records: bytes | memoryview, start: int, end: int, compressor: zstandard.ZstdCompressor) -> bytes:
    """Pack a chunk record with the packed `records`; `start` and `end` are their first and last log time in ns."""
    data = compressor.compress(records)
    length = CHUNK_HEAD.size - PREFIX.size + len(data)
    crc = crc32(records)
    return CHUNK_HEAD.pack(Opcode.CHUNK, length, start, end, len(records), crc, 4, b"zstd", len(data)) + data


def pack_index(channel: int, times: npt.ArrayLike, offsets: npt.ArrayLike) -> bytes:
    """Pack a message index record; `times` in ns, `offsets` in bytes into the chunk's content."""
    pairs = np.column_stack([np.asarray(times, np.uint64), np.asarray(offsets, np.uint64)]).tobytes()
    head = PREFIX.pack(Opcode.MESSAGE_INDEX, 6 + len(pairs)) + channel.to_bytes(2, "little")
    return head + len(pairs).to_bytes(4, "little") + pairs


def parse_chunk_head(data: bytes) -> ChunkHead:
    """Parse the beginning of a chunk record.

    Raises DamagedChunk if `data` is cut off, its fields contradict each other, the compression is not zstd, or the
    content has more than LARGEST_CHUNK_BYTES.
    """
    if len(data) < CHUNK_HEAD.size:
        raise DamagedChunk("cut off")
    opcode, length, start, end, uncompressed, crc, name_length, name, compressed = CHUNK_HEAD.unpack_from(data)
    is_zstd_chunk = opcode == Opcode.CHUNK and name_length == 4 and name == b"zstd"
    if not is_zstd_chunk or length != CHUNK_HEAD.size - PREFIX.size + compressed or uncompressed > LARGEST_CHUNK_BYTES:
        raise DamagedChunk("the header contradicts itself")
    return ChunkHead(start, end, uncompressed, crc, compressed)


def unpack_chunk(record: bytes) -> bytes:
    """Decompress a whole chunk record. Returns its content.

    Raises DamagedChunk if it is cut off, its header or sizes are wrong, it has more than LARGEST_CHUNK_BYTES, it cannot
    be decompressed, or its checksum differs.
    """
    head = parse_chunk_head(record)
    data = memoryview(record)[CHUNK_HEAD.size :]
    if len(data) != head.compressed:
        raise DamagedChunk("cut off")
    try:
        # The size in the frame is checked first, so that a damaged frame cannot allocate all the memory.
        if zstandard.get_frame_parameters(data).content_size != head.uncompressed:
            raise DamagedChunk("the compressed data and the header give different sizes")
        content = _decompressors.of_thread.decompress(data, allow_extra_data=False)
    except zstandard.ZstdError:
        raise DamagedChunk("cannot be decompressed") from None
    if crc32(content) != head.crc:
        raise DamagedChunk("the checksum differs")
    return content


def split_records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield (opcode, content) of each record in `data`. Raises DamagedChunk for a record that is cut off."""
    position = 0
    while position < len(data):
        if position + PREFIX.size > len(data):
            raise DamagedChunk("a record is cut off")
        opcode, length = PREFIX.unpack_from(data, position)
        position += PREFIX.size
        if position + length > len(data):
            raise DamagedChunk("a record is cut off")
        yield opcode, data[position : position + length]
        position += length


def pack_end(
    data_crc: int, data_end: int, repeated: Sequence[McapRecord], statistics: Statistics, index: bytes
) -> bytes:
    """Pack the end of a file: data end, summary, footer, magic.

    `data_end` is the number of bytes before it, `data_crc` their checksum, `repeated` the schemas and channels of the
    file, `index` the packed chunk index records.
    """
    start = data_end + DATA_END_BYTES
    summary, offsets = b"", []
    groups: dict[type[McapRecord], list[McapRecord]] = {}
    for record in (*repeated, statistics):
        groups.setdefault(type(record), []).append(record)
    for packed in filter(None, (*map(pack_records, groups.values()), index)):
        offsets.append(SummaryOffset(packed[0], start + len(summary), len(packed)))
        summary += packed
    offsets_start = start + len(summary)
    summary += pack_records(offsets)
    head = FOOTER_HEAD.pack(Opcode.FOOTER, 20, start, offsets_start)
    footer = Footer(start, offsets_start, crc32(head, crc32(summary)))
    return pack_records([DataEnd(data_crc)]) + summary + pack_records([footer]) + MAGIC


def index_record_span(record: bytes) -> tuple[int, int, int]:
    """Return first log time (ns), last log time (ns) and offset of the chunk (bytes) in a packed chunk index record."""
    _, _, start, end, offset = CHUNK_INDEX_HEAD.unpack_from(record)
    return start, end, offset


@lru_cache(maxsize=1)
def parse_summary(data: bytes) -> tuple[IndexedChunk, ...]:
    """Parse the chunk indexes in `data`: the summary section and the footer, without the magic bytes behind it.

    The result of the newest `data` is cached: a replay opens its file several times, and forked processes inherit the
    cache. Raises DamagedChunk if the checksum differs, an index record cannot be read, or the summary holds data.
    """
    (crc,) = struct.unpack_from("<I", data, len(data) - 4)
    if crc32(data[:-4]) != crc:
        raise DamagedChunk("the checksum of the index at the end of the file is wrong")
    known_channels: dict[tuple[int, ...], tuple[int, ...]] = {}
    indexes = []
    try:
        for opcode, content in split_records(data[:-FOOTER_BYTES]):
            if opcode == Opcode.CHUNK_INDEX:
                indexes.append(_parse_chunk_index(content, known_channels))
            elif opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                raise DamagedChunk("chunks or messages follow the end of the data")
        return tuple(indexes)
    except struct.error as error:
        raise DamagedChunk(f"the chunk index cannot be read ({error})") from None


def _parse_chunk_index(content: bytes, known_channels: dict[tuple[int, ...], tuple[int, ...]]) -> IndexedChunk:
    """Parse the content of a chunk index record. Raises struct.error if the content is cut off.

    `known_channels` maps each tuple of channels to itself, so that chunks with the same channels share one tuple, which
    saves memory. A new tuple is added.
    """
    start, end, offset, length, places_bytes = INDEX_BEGIN.unpack_from(content)
    position = INDEX_BEGIN.size + places_bytes
    channels = tuple(channel for channel, _ in INDEX_PLACE.iter_unpack(content[INDEX_BEGIN.size : position]))
    index_length, name_length = INDEX_NAME.unpack_from(content, position)
    _, uncompressed = INDEX_SIZES.unpack_from(content, position + INDEX_NAME.size + name_length)
    return IndexedChunk(
        offset, length, index_length, start, end, uncompressed, known_channels.setdefault(channels, channels)
    )
