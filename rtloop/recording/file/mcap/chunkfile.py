"""An MCAP file that grows chunk by chunk; each chunk is written as a whole or not at all.

The file is called `PATH.part` (or another suffix) from its first chunk on and `PATH` once it has its index; it can be
read under either name. Cut off at any moment, it holds all chunks up to the last one. On a full disk its last
chunks can be dropped to make room for the index.
"""

from __future__ import annotations

import contextlib
import errno
import os
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.records import Channel, ChunkIndex, Header, McapRecord, Schema, Statistics

from rtloop.errors import OutputError
from rtloop.foundation.trusted import UntrustedPath, close_descriptor, replace_file
from rtloop.recording.file.mcap.checksum import crc32
from rtloop.recording.file.mcap.container import (
    CHUNK_HEAD,
    MAGIC,
    index_record_span,
    pack_chunk,
    pack_end,
    pack_records,
)

LEVEL = 3
"""zstd: at 10 kHz and one axis 0.70 µs and 73 bytes a tick; level 1: 0.52 µs, 85 bytes; level 5: 1.7 µs, 71 bytes."""
COMPRESSION = zstandard.ZstdCompressionParameters.from_level(
    LEVEL, window_log=20, hash_log=16, chain_log=14, min_match=4
)
"""LEVEL with smaller tables, which fit a processor's cache; the window holds a whole chunk.

A tick resembles the tick before it, so short matches are near: a fifth less time than LEVEL alone, and no more bytes.
"""


class NotOnDisk(OutputError):
    """The system could not store a written file on the disk; it may have lost any part, and reports that only once."""


class ChunkContent(NamedTuple):
    """Content of a chunk: records, first and last log time in ns, number of messages and index record by channel."""

    records: bytes | memoryview
    start: int
    end: int
    counts: dict[int, int]
    indexes: dict[int, bytes]


class PackedChunk(NamedTuple):
    """A chunk that is ready for the file: its compressed record, and the fields of its entry in the index.

    `uncompressed_bytes` is the size of its content; `start`, `end`, `counts` and `indexes` are those of ChunkContent.
    """

    record: bytes
    uncompressed_bytes: int
    start: int
    end: int
    counts: dict[int, int]
    indexes: dict[int, bytes]


class _Compressors(threading.local):
    """The compressor of each thread, `of_thread`, which all its chunks share: threads cannot share one."""

    def __init__(self) -> None:
        """Make the compressor of a thread, at its first use there."""
        self.of_thread = zstandard.ZstdCompressor(compression_params=COMPRESSION)


_compressors = _Compressors()


def compress_chunk(content: ChunkContent) -> PackedChunk:
    """Compress a chunk; may run in several threads at once. The content may change after the return."""
    record = pack_chunk(content.records, content.start, content.end, _compressors.of_thread)
    return PackedChunk(record, len(content.records), *content[1:])


class _WrittenChunk(NamedTuple):
    """Data stored in memory for every written chunk: its packed index record, and the data needed to drop it."""

    record: bytes
    counts: dict[int, int]
    crc_before: int


class ChunkFile:
    """MCAP file that grows chunk by chunk; the methods that write raise OutputError."""

    def __init__(self, path: Path, header: Header, repeated: Sequence[McapRecord], suffix: str = ".part") -> None:
        """Create and lock the file and write `header`; the summary will repeat the schemas and channels `repeated`.

        The file is named `path` plus `suffix` from its first chunk until it is finished. Raises OutputError if `path`,
        finished or unfinished, exists, another process is creating it, or it cannot be written.
        """
        self.path, self.part = path, path.with_name(path.name + suffix)
        self._name = path.with_name(f"{self.part.name}.new")
        self.size = 0
        self._repeated = repeated
        self._chunks: list[_WrittenChunk] = []
        self._distinct_counts: dict[tuple[tuple[int, int], ...], dict[int, int]] = {}
        self._crc = 0
        self._fd = self._open()
        try:
            self._append(MAGIC + pack_records([header]))
        except OutputError:
            self.discard()
            raise

    def __len__(self) -> int:
        """Number of written chunks."""
        return len(self._chunks)

    @property
    def end_bytes(self) -> int:
        """Estimated size, in bytes, of the index that `write_end` would write."""
        return sum(len(chunk.record) for chunk in self._chunks)

    def is_in_place(self) -> bool:
        """Whether the unfinished file still lies under its name; True if that is unknown.

        A removed file can be written, but is lost.
        """
        try:
            return os.path.samestat(os.lstat(self._name), self._created_status)
        except (FileNotFoundError, NotADirectoryError):
            return False
        except OSError:
            return True  # Unknown; the next write fails if the file is gone.

    def append_chunk(self, chunk: PackedChunk) -> None:
        """Write one chunk and its index records, if it has any, as a whole or not at all.

        The first chunk gives the file the name PATH.part. Raises OutputError, with nothing written, if the write fails,
        and with the chunk written if the file cannot get that name.
        """
        index_begin = self.size + len(chunk.record)
        position, index_offsets = index_begin, {}
        for channel, record in chunk.indexes.items():
            index_offsets[channel] = position
            position += len(record)
        entry = ChunkIndex(
            chunk_length=len(chunk.record),
            chunk_start_offset=self.size,
            compression="zstd",
            compressed_size=len(chunk.record) - CHUNK_HEAD.size,
            message_end_time=chunk.end,
            message_index_length=position - index_begin,
            message_index_offsets=index_offsets,
            message_start_time=chunk.start,
            uncompressed_size=chunk.uncompressed_bytes,
        )
        counts = self._distinct_counts.setdefault(tuple(chunk.counts.items()), chunk.counts)
        written_chunk = _WrittenChunk(pack_records([entry]), counts, self._crc)
        self._append(chunk.record + b"".join(chunk.indexes.values()))
        self._chunks.append(written_chunk)
        if self._name != self.part:
            self._rename_to_part()

    def drop_last_chunk(self) -> dict[int, int]:
        """Remove the last chunk, of one or more. Returns its number of messages by channel id.

        Raises OutputError, with nothing changed, if the file cannot be cut.
        """
        chunk = self._chunks[-1]
        _, _, begin = index_record_span(chunk.record)
        with self._output_errors():
            os.ftruncate(self._fd, begin)
        self._chunks.pop()
        self.size, self._crc = begin, chunk.crc_before
        return chunk.counts

    def write_end(self) -> None:
        """Write the index and the footer; there must be a chunk. Raises OutputError."""
        index = b"".join(chunk.record for chunk in self._chunks)
        self._append(pack_end(self._crc, self.size, self._repeated, self._statistics(), index))

    def publish(self) -> None:
        """Make the file durable, give it its final name and close it, also after an error; never replaces a file.

        Raises NotOnDisk if it is not durable, OutputError if it was removed, the final name is taken or it cannot be
        renamed; after each of these errors the file keeps the name of an unfinished one.
        """
        try:
            self._make_durable()
            if not self.is_in_place():
                raise OutputError(f"{self.part}: this file was removed during the recording", errno.ENOENT)
            if os.path.lexists(self.path):
                message = f"{self.path}: another process has created this file; the recording stays in {self.part}"
                raise OutputError(message, errno.EEXIST)
            with self._output_errors():
                os.rename(self.part, self.path)
        finally:
            self.close()
        with contextlib.suppress(OSError):  # The file is whole; without its new name on the disk it is still a .part.
            self._sync_folder()

    def _make_durable(self) -> None:
        """Store the file on the disk. Raises NotOnDisk if that fails; a second try would hide the loss."""
        try:
            os.fsync(self._fd)
        except OSError as error:
            message = (
                f"{self.part}: {error.strerror}; part of the file may not be on the disk. `rtloop recover` saves the "
                "readable rest"
            )
            raise NotOnDisk(message, error.errno or 0) from None

    def close(self) -> None:
        """Close the file without finishing it; the file stays on the disk. Do nothing if it is closed already."""
        if self._fd >= 0:
            close_descriptor(self._fd)  # Errors do not matter: the data is synced.
            self._fd = -1

    def discard(self) -> None:
        """Close the file, and remove it unless its name now belongs to another file. Raises no error."""
        with contextlib.suppress(OSError):
            if self.is_in_place():
                os.unlink(self._name)
        self.close()

    def _open(self) -> int:
        """Create and lock the file under a name that no program takes for a recording; replaces a leftover one.

        Returns the file's descriptor. Raises OutputError if a finished or unfinished recording of this name exists,
        another process has the lock, or the file cannot be created.
        """
        import fcntl  # Absent on Windows, where recordings are read and never written.

        self._refuse_to_replace()
        with self._output_errors():
            fd = replace_file(self._name, 0o644)
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)  # No program recovers a locked file.
                self._created_status = os.fstat(fd)
                if not self.is_in_place():
                    raise BlockingIOError
            except OSError:
                close_descriptor(fd)
                raise
        return fd

    def _rename_to_part(self) -> None:
        """Give the file, which has its first chunk, the name PATH.part under which it grows.

        Raises OutputError if a recording of this name, finished or unfinished, exists.
        """
        self._refuse_to_replace()
        with self._output_errors():
            os.rename(self._name, self.part)
        self._name = self.part

    def _sync_folder(self) -> None:
        """Store the name of the file on the disk. Raises OSError."""
        folder = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            close_descriptor(folder)

    def _refuse_to_replace(self) -> None:
        """Raise OutputError if a finished or unfinished recording of this name exists."""
        with self._output_errors():
            has_final, has_part = _name_exists(self.path), _name_exists(self.part)
        if has_final:
            raise OutputError(f"{self.path} exists already; a recording is never overwritten", errno.EEXIST)
        if has_part:
            message = f"{self.part} exists already, left from an unfinished run; `rtloop recover` completes it"
            raise OutputError(message, errno.EEXIST)

    def _append(self, data: bytes) -> None:
        """Append `data`, as a whole or not at all, and update size and checksum. Raises OutputError."""
        try:
            written_bytes = 0
            while written_bytes < len(data):
                written_bytes += os.pwrite(self._fd, data[written_bytes:], self.size + written_bytes)
        except OSError as error:
            with contextlib.suppress(OSError):  # Otherwise the rest is overwritten, or recognised as cut off.
                os.ftruncate(self._fd, self.size)
            raise self._output_error(error) from None
        self.size += len(data)
        self._crc = crc32(data, self._crc)

    def _statistics(self) -> Statistics:
        """Statistics record over the written chunks, one or more."""
        starts, ends, _ = zip(*(index_record_span(chunk.record) for chunk in self._chunks), strict=True)
        counts: Counter[int] = Counter()
        for chunk in self._chunks:
            counts.update(chunk.counts)
        return Statistics(
            attachment_count=0,
            channel_count=sum(isinstance(record, Channel) for record in self._repeated),
            channel_message_counts=counts,
            chunk_count=len(self._chunks),
            message_count=sum(counts.values()),
            message_end_time=max(ends),
            message_start_time=min(starts),
            metadata_count=0,
            schema_count=sum(isinstance(record, Schema) for record in self._repeated),
        )

    @contextlib.contextmanager
    def _output_errors(self) -> Iterator[None]:
        """Convert an OSError inside the block to the OutputError of `_output_error`."""
        try:
            yield
        except OSError as error:
            raise self._output_error(error) from None

    def _output_error(self, error: OSError) -> OutputError:
        """Return the OutputError that names the refused path and the cause of `error`."""
        if isinstance(error, BlockingIOError):
            return OutputError(f"{self.part}: another process writes the same recording", errno.EWOULDBLOCK)
        path = error.filename if isinstance(error, UntrustedPath) else self.part
        return OutputError(f"{path}: {error.strerror}", error.errno or 0)


def _name_exists(path: Path) -> bool:
    """Whether a file, or a link to no file, has this name. Raises OSError if that is unknown."""
    try:
        os.lstat(path)
    except FileNotFoundError:
        return False
    return True
