"""An MCAP file that grows chunk by chunk, each written whole or not at all.

`PATH.part` (or another suffix) from its first chunk on, `PATH` once it has its index: a file under either name can be
read. Cut off at any moment, it holds everything up to its last chunk; a full disk leaves room for the index by giving
up the last chunks.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.records import Channel, ChunkIndex, Header, McapRecord, Schema, Statistics

from rtloop.errors import OutputError
from rtloop.foundation.trusted import UntrustedPath, close_descriptor, replace_file
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


class NotOnDisk(OutputError):
    """The system could not bring a written file to the disk: it may have given up any of it, and says so only once."""


class ChunkContent(NamedTuple):
    """What a chunk holds: its records, the span of their log times, messages and index record by channel."""

    records: bytes | memoryview
    start: int
    end: int
    counts: dict[int, int]
    indexes: dict[int, bytes]


class _WrittenChunk(NamedTuple):
    """Kept for every chunk of a file, therefore small: its packed record of the index, and what undoing it needs."""

    record: bytes
    counts: dict[int, int]
    crc_before: int


class ChunkFile:
    """`repeated`: the schemas and channels that the summary repeats. All methods raise OutputError."""

    def __init__(self, path: Path, header: Header, repeated: Sequence[McapRecord], suffix: str = ".part") -> None:
        self.path, self.part = path, path.with_name(path.name + suffix)
        self._name = path.with_name(f"{self.part.name}.new")
        self.size = 0
        self._repeated = repeated
        self._compressor = zstandard.ZstdCompressor(level=LEVEL)
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
        return len(self._chunks)

    @property
    def end_bytes(self) -> int:
        """About what the index will take."""
        return sum(len(chunk.record) for chunk in self._chunks)

    def is_in_place(self) -> bool:
        """Whether the unfinished file still lies under its name: a removed one can be written, and is lost."""
        try:
            return os.path.samestat(os.lstat(self._name), self._created_status)
        except (FileNotFoundError, NotADirectoryError):
            return False
        except OSError:
            return True  # nobody knows; writing will tell

    def append_chunk(self, content: ChunkContent) -> None:
        """Compress and write one chunk and its index records, if it has any."""
        chunk = pack_chunk(content.records, content.start, content.end, self._compressor)
        index_begin = self.size + len(chunk)
        position, index_offsets = index_begin, {}
        for channel, record in content.indexes.items():
            index_offsets[channel] = position
            position += len(record)
        entry = ChunkIndex(
            chunk_length=len(chunk),
            chunk_start_offset=self.size,
            compression="zstd",
            compressed_size=len(chunk) - CHUNK_HEAD.size,
            message_end_time=content.end,
            message_index_length=position - index_begin,
            message_index_offsets=index_offsets,
            message_start_time=content.start,
            uncompressed_size=len(content.records),
        )
        counts = self._distinct_counts.setdefault(tuple(content.counts.items()), content.counts)
        written_chunk = _WrittenChunk(pack_records([entry]), counts, self._crc)
        self._append(chunk + b"".join(content.indexes.values()))
        self._chunks.append(written_chunk)
        if self._name != self.part:
            self._rename_to_part()

    def drop_last_chunk(self) -> dict[int, int]:
        """Take the last chunk off the file; returns its messages by channel."""
        chunk = self._chunks.pop()
        _, _, self.size = index_record_span(chunk.record)
        self._crc = chunk.crc_before
        try:
            os.ftruncate(self._fd, self.size)
        except OSError as error:
            raise self._output_error(error) from None
        return chunk.counts

    def write_end(self) -> None:
        """The index and the footer."""
        index = b"".join(chunk.record for chunk in self._chunks)
        self._append(pack_end(self._crc, self.size, self._repeated, self._statistics(), index))

    def publish(self) -> None:
        """Make the file durable and give it its final name; never replaces a file.

        Raises NotOnDisk where it is not durable; it keeps the name of an unfinished file then.
        """
        try:
            self._make_durable()
            if not self.is_in_place():
                raise OutputError(f"{self.part}: was removed while it was written", errno.ENOENT)
            if os.path.lexists(self.path):
                message = f"{self.path} appeared while it was written; the recording stays in {self.part}"
                raise OutputError(message, errno.EEXIST)
            os.rename(self.part, self.path)
        except OSError as error:
            raise self._output_error(error) from None
        finally:
            self.close()
        with contextlib.suppress(OSError):  # the file is whole: without its name on the disk it is found as a .part
            self._sync_folder()

    def _make_durable(self) -> None:
        """Have the system put the file on the disk. Raises NotOnDisk; a second try would say nothing."""
        try:
            os.fsync(self._fd)
        except OSError as error:
            message = (
                f"{self.part}: {error.strerror}: some of it may not be on the disk; `rtloop recover` keeps the rest"
            )
            raise NotOnDisk(message, error.errno or 0) from None

    def close(self) -> None:
        """Give up the file as it is; idempotent."""
        if self._fd >= 0:
            close_descriptor(self._fd)  # what counts is that it was synced
            self._fd = -1

    def discard(self) -> None:
        """Give up the file and remove it."""
        with contextlib.suppress(OSError):
            os.unlink(self._name)
        self.close()

    def _open(self) -> int:
        """Of a file that nobody takes for a recording yet; one that was left so is begun anew."""
        self._refuse_to_replace()
        try:
            fd = replace_file(self._name, 0o644)
        except OSError as error:
            raise self._output_error(error) from None
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)  # so that nobody recovers it while it grows
            self._created_status = os.fstat(fd)
            if not self.is_in_place():
                raise BlockingIOError(errno.EWOULDBLOCK, "another process began it as well")
        except OSError as error:
            close_descriptor(fd)
            raise self._output_error(error) from None
        return fd

    def _rename_to_part(self) -> None:
        """Give the file, which has its first chunk, the name under which it grows."""
        self._refuse_to_replace()
        try:
            os.rename(self._name, self.part)
        except OSError as error:
            raise self._output_error(error) from None
        self._name = self.part

    def _sync_folder(self) -> None:
        folder = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            close_descriptor(folder)

    def _refuse_to_replace(self) -> None:
        try:
            has_final, has_part = _name_exists(self.path), _name_exists(self.part)
        except OSError as error:
            raise self._output_error(error) from None
        if has_final:
            raise OutputError(f"{self.path} exists already; a recording is never overwritten", errno.EEXIST)
        if has_part:
            message = f"{self.part} is left from an unfinished run; `rtloop recover` completes it"
            raise OutputError(message, errno.EEXIST)

    def _append(self, data: bytes) -> None:
        """All of `data` at the end of the file, or nothing of it."""
        try:
            written_bytes = 0
            while written_bytes < len(data):
                written_bytes += os.pwrite(self._fd, data[written_bytes:], self.size + written_bytes)
        except OSError as error:
            with contextlib.suppress(OSError):  # what is left of it is overwritten, or recognised as cut off
                os.ftruncate(self._fd, self.size)
            raise self._output_error(error) from None
        self.size += len(data)
        self._crc = zlib.crc32(data, self._crc)

    def _statistics(self) -> Statistics:
        starts, ends, _ = zip(*(index_record_span(chunk.record) for chunk in self._chunks), strict=True)
        counts: dict[int, int] = {}
        for chunk in self._chunks:
            for channel, count in chunk.counts.items():
                counts[channel] = counts.get(channel, 0) + count
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

    def _output_error(self, error: OSError) -> OutputError:
        path = error.filename if isinstance(error, UntrustedPath) else self.part
        return OutputError(f"{path}: {error.strerror}", error.errno or 0)


def _name_exists(path: Path) -> bool:
    """Whether anything, be it a link that leads nowhere, has this name. Raises OSError where that cannot be told."""
    try:
        os.lstat(path)
    except FileNotFoundError:
        return False
    return True
