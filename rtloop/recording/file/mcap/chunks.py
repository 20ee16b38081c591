"""Find the chunks of an MCAP file: by its index, or by a scan if the index is missing or damaged."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode

from rtloop.foundation.trusted import close_descriptor, open_user_file
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.mcap.container import (
    CHUNK_HEAD,
    CHUNK_MARK,
    CHUNK_MARK_OFFSET,
    DATA_END_BYTES,
    FOOTER_BYTES,
    FOOTER_HEAD,
    MAGIC,
    PREFIX,
    DamagedChunk,
    IndexedChunk,
    parse_chunk_head,
    parse_summary,
)

SEARCH_BYTES = 1 << 20
INDEX_HEAD_BYTES = PREFIX.size + 6
Opener = Callable[[Path], int]
"""`open_user_file`, `open_without_link` or `open_own` of `rtloop.foundation.trusted`."""
LARGEST_SUMMARY_BYTES = 16 << 20
"""Maximum by which a summary may exceed the data before it; an index is smaller than its chunks."""


_POSITION_LOCK = threading.Lock()
"""Held while a file's position is moved and used, where the system cannot read at a given place."""


def _read_at(fd: int, length: int, offset: int) -> bytes:
    """Return up to `length` bytes of an open file from `offset` on, in any thread. Raises OSError."""
    if hasattr(os, "pread"):
        return os.pread(fd, length, offset)
    with _POSITION_LOCK:  # Windows
        os.lseek(fd, offset, os.SEEK_SET)
        return os.read(fd, length)


class ChunkEntry(NamedTuple):
    """Offset and length of a chunk record in bytes, and its entry of the index; None without an index."""

    offset: int
    length: int
    index: IndexedChunk | None  # pyright: ignore[reportIncompatibleMethodOverride]


class McapSource:
    """File that any thread can read at any place."""

    def __init__(self, path: Path, opener: Opener = open_user_file) -> None:
        """Open the file by `opener`. Raises RecordingError if it cannot be opened or is no MCAP file."""
        self.path, self._fd = path, -1
        try:
            self._fd = opener(path)
            status = os.fstat(self._fd)
            self.size = status.st_size
            self.identity = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
            """Value that is equal for the same, unchanged file."""
            magic = _read_at(self._fd, len(MAGIC), 0)
        except FileNotFoundError:
            raise RecordingError(f"{path}: no such file{_file_name_hint(path)}") from None
        except OSError as error:
            self.close()
            raise RecordingError(f"{path}: {error.strerror}") from None
        if magic != MAGIC:
            self.close()
            description = ""
            if MAGIC.startswith(magic):
                description = "a file that is cut off in its first bytes" if magic else "an empty file"
            if magic and path.suffix == ".toml":
                description = "a text in TOML; `rtloop check` reads configurations, `rtloop design` specifications"
            raise RecordingError(f"{path}: not a recording: {description or 'not an MCAP file'}")

    def read(self, offset: int, length: int) -> bytes:
        """Read up to `length` bytes from `offset` on; fewer at the end of the file.

        Raises RecordingError if the system cannot read the file.
        """
        try:
            return _read_at(self._fd, length, offset)
        except OSError as error:
            raise RecordingError(f"{self.path}: {error.strerror}") from None

    def close(self) -> None:
        """Close the descriptor of the file, if it is open."""
        if self._fd >= 0:
            close_descriptor(self._fd)
            self._fd = -1


def _file_name_hint(path: Path) -> str:
    """Return ", but there is …" with the finished file of a missing unfinished one, or the reverse; "" without it."""
    if path.suffix == ".part" and path.with_suffix("").exists():
        return f", but there is {path.with_suffix('').name}, which was finished or recovered meanwhile"
    part = path.with_name(path.name + ".part")
    return f", but there is {part.name}, left from an unfinished run" if part.exists() else ""


def read_chunk_index(source: McapSource) -> list[ChunkEntry]:
    """Read the chunks from the index of a finished file.

    Raises DamagedChunk if the index is missing or damaged, RecordingError if the file cannot be read.
    """
    tail = source.read(max(source.size - FOOTER_BYTES - len(MAGIC), 0), FOOTER_BYTES + len(MAGIC))
    if len(tail) < FOOTER_BYTES + len(MAGIC) or not tail.endswith(MAGIC):
        raise DamagedChunk("the file was not finished")
    opcode, length, start, _ = FOOTER_HEAD.unpack_from(tail)
    is_footer = opcode == Opcode.FOOTER and length == FOOTER_BYTES - PREFIX.size and len(MAGIC) < start < source.size
    if not is_footer or source.size - start > start + LARGEST_SUMMARY_BYTES:
        raise DamagedChunk("the end of the file is damaged")
    indexes = parse_summary(source.read(start, source.size - len(MAGIC) - start))
    _require_contiguous(source, indexes, start - DATA_END_BYTES)
    return [ChunkEntry(index.offset, index.length, index) for index in indexes]


def _require_contiguous(source: McapSource, indexes: Sequence[IndexedChunk], end: int) -> None:
    """Raise DamagedChunk unless the indexed chunks, each with its message indexes, fill the data section to `end`."""
    _, position = _parse_record(source, len(MAGIC))
    position += len(MAGIC)
    for index in indexes:
        if index.offset != position or index.length < CHUNK_HEAD.size:
            break
        position += index.length + index.index_length
    if position != end:
        raise DamagedChunk("the chunk index at the end of the file does not match its data")


def require_message_indexes(source: McapSource, entry: ChunkEntry) -> None:
    """Raise DamagedChunk unless only message indexes lie where the index of the file puts those of a chunk.

    Without an entry of the index nothing is checked. Raises RecordingError if the file cannot be read.
    """
    position = entry.offset + entry.length
    end = position + (entry.index.index_length if entry.index else 0)
    while position < end:
        chunk, length = _parse_record(source, position)
        if chunk or not length:
            break
        position += length
    if position != end:
        raise DamagedChunk("the message indexes behind it are damaged, or other data")


def scan_chunks(source: McapSource, position: int = len(MAGIC)) -> tuple[list[ChunkEntry], list[str]]:
    """Scan the file from the record at `position` to the end of its data. Returns the whole chunks and the faults.

    A damaged part is skipped up to the next chunk, and is a fault, as is a chunk that is cut off: one sentence each.
    The contents of the chunks are not checked. Raises RecordingError if the file cannot be read.
    """
    entries: list[ChunkEntry] = []
    problems: list[str] = []
    while position < source.size:
        entry, length = _parse_record(source, position)
        if entry:
            entries.append(entry)
        if length:
            position += length
            continue
        if source.read(position, 1) == bytes([Opcode.DATA_END]):
            if _next_chunk(source, position) is not None:
                problems.append("chunks follow the end of the data")
            break
        next_offset = _next_chunk(source, position + 1)
        if next_offset is None:
            problems.append(
                f"the file ends in the middle of a chunk: its last {source.size - position} bytes are left out"
            )
            break
        problems.append(f"bytes {position} to {next_offset} are damaged")
        position = next_offset
    return entries, problems


def _parse_record(source: McapSource, position: int) -> tuple[ChunkEntry | None, int]:
    """Return the chunk at `position`, or None, and the length in bytes of the record there.

    The length is 0 for a record that is cut off, damaged or none of chunk, message index and header.
    """
    head = source.read(position, CHUNK_HEAD.size)
    if len(head) < INDEX_HEAD_BYTES:
        return None, 0
    opcode, length = PREFIX.unpack_from(head)
    record_length = PREFIX.size + length
    if position + record_length > source.size:
        return None, 0
    if opcode == Opcode.CHUNK:
        try:
            parse_chunk_head(head)
        except DamagedChunk:
            return None, 0
        return ChunkEntry(position, record_length, None), record_length
    entries_length = int.from_bytes(head[PREFIX.size + 2 : INDEX_HEAD_BYTES], "little")
    is_index = opcode == Opcode.MESSAGE_INDEX and length == 6 + entries_length
    is_header = opcode == Opcode.HEADER and position == len(MAGIC)
    return None, record_length if is_index or is_header else 0


def _next_chunk(source: McapSource, position: int) -> int | None:
    """Offset of the first whole chunk record at or after `position`; None if there is none."""
    search = position + CHUNK_MARK_OFFSET
    while search < source.size:
        block = source.read(search, SEARCH_BYTES)
        place = block.find(CHUNK_MARK)
        while place >= 0:
            candidate = search + place - CHUNK_MARK_OFFSET
            if _parse_record(source, candidate)[0]:
                return candidate
            place = block.find(CHUNK_MARK, place + 1)
        if len(block) < SEARCH_BYTES:
            return None
        search += len(block) - len(CHUNK_MARK) + 1
    return None
