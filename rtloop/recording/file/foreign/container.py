"""Chunks as any tool may write them: zstd in any frames, lz4 or as they are, with a checksum or without one."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable

import lz4.frame
import zstandard

from rtloop.recording.file.mcap.container import PREFIX, DamagedChunk

HEAD = struct.Struct("<BQQQQII")
"""Of a chunk record: opcode, length, first and last log time, uncompressed size, CRC-32, length of what follows."""
LARGEST_BYTES = 32 << 20
"""Of a record, and of a chunk's content; beyond that it is left alone rather than allocated."""
LONGEST_NAME = 32
_SIZE = struct.Struct("<Q")


def said_size(head: bytes | memoryview) -> int:
    """What the beginning of a chunk record says of the size of its content, in bytes."""
    return HEAD.unpack_from(head)[4]


def unpack(record: memoryview) -> memoryview:
    """The content of a chunk record. Raises DamagedChunk where it is not what its head says."""
    if len(record) < HEAD.size:
        raise DamagedChunk("cut off")
    _, _, _, _, size, crc, name_length = HEAD.unpack_from(record)
    data_at = HEAD.size + name_length + _SIZE.size
    if name_length > LONGEST_NAME or data_at > len(record) or size > LARGEST_BYTES:
        raise DamagedChunk("its header contradicts itself")
    name = bytes(record[HEAD.size : HEAD.size + name_length]).decode(errors="replace")
    data = record[data_at:]
    if _SIZE.unpack_from(record, data_at - _SIZE.size)[0] != len(data):
        raise DamagedChunk("its header contradicts itself")
    if name not in _DECOMPRESS:
        raise DamagedChunk(f"its compression is {name!r}; zstd, lz4 and none can be read")
    try:
        content = _DECOMPRESS[name](data, size + 1)
    except (zstandard.ZstdError, RuntimeError, EOFError):
        raise DamagedChunk("it cannot be decompressed") from None
    if len(content) != size:
        raise DamagedChunk("its size is not what it says")
    if crc and zlib.crc32(content) != crc:  # 0: whoever wrote it left the checksum out
        raise DamagedChunk("its checksum differs")
    return memoryview(content)


def _zstd(data: memoryview, most: int) -> bytes:
    decompressor = zstandard.ZstdDecompressor(max_window_size=LARGEST_BYTES)
    with decompressor.stream_reader(data, read_across_frames=True) as reader:
        return reader.read(most)


def _lz4(data: memoryview, most: int) -> bytes:
    return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most)


_DECOMPRESS: dict[str, Callable[[memoryview, int], bytes | memoryview]] = {
    "": lambda data, most: data[:most],
    "zstd": _zstd,
    "lz4": _lz4,
}


def record_length(head: bytes | memoryview, at: int) -> int:
    """Of the whole record that begins at `at`, its prefix included; as it says itself."""
    return PREFIX.size + PREFIX.unpack_from(head, at)[1]
