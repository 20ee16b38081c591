"""Write one recording: the header, then chunks of ticks and chunks of messages of the slow topics."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import itertools
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mcap.records import Header, McapRecord

from rtloop.errors import LOW_SPACE, OutputError, output_errors
from rtloop.foundation.arrays import Real
from rtloop.recording.file.mcap.chunkfile import ChunkContent, ChunkFile, PackedChunk, compress_chunk
from rtloop.recording.file.mcap.container import pack_index, pack_message, pack_records
from rtloop.recording.file.tick_packer import TickPacker
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.overview import Intervals, OverviewLayout, overview_records, tick_ranges

DISK_FULL_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class Writer:
    """Writer of one recording. The methods that write raise OutputError; written chunks stay valid."""

    def __init__(
        self,
        path: Path,
        header: Mapping[str, Any],
        log_time: int,
        *,
        message_index: bool = False,
        min_free_bytes: int = 0,
        room_bytes: int = 0,
        suffix: str = ".part",
    ) -> None:
        """Create the file of the recording `path`; `header` becomes its /configuration message at `log_time` (UNIX ns).

        Ticks are logged at the attribute `start_unix_ns`, by default `log_time`, plus their deadline. `message_index`
        adds 16 bytes of index to every tick, which some viewers need. The writer refuses to write with less than
        `min_free_bytes` of free space, and to begin a file with less than `room_bytes` more. `suffix` marks the
        unfinished file. Raises OutputError if the file exists or cannot be written; a file that could not be begun is
        removed.
        """
        self.path = path
        self.start_unix_ns = log_time
        self.ticks = self.ticks_skipped = 0
        """Number of ticks written, and of ticks that overviews replace."""
        self._skipped_counts: list[int] = []
        self._columns: list[str] = header["columns"]
        self._min_free_bytes = min_free_bytes
        self._packer = TickPacker(self._columns, message_index=message_index)
        self._packed: Iterator[PackedChunk] | None = None
        self._check_space(room_bytes)
        repeated = [*format.schemas(self._columns), *format.channels()]
        if header.get("around"):
            repeated += overview_records(self._columns)
        self.file = ChunkFile(path, Header(format.PROFILE, format.LIBRARY), repeated, suffix)
        try:
            self._write_header(header, log_time, repeated)
        except OutputError:
            self.file.discard()
            raise

    @property
    def part(self) -> Path:
        """Path of the file from its first chunk, the header, until it is finished."""
        return self.file.part

    @contextlib.contextmanager
    def packing(self, rows: Real) -> Iterator[None]:
        """Pack rows (n, columns) of ticks by several threads, while the block writes them by `write`, chunk by chunk.

        Each `write` in the block must have the next `format.chunk_rows` rows, and the last one the rest;
        `start_unix_ns` must not change.
        """
        self._packed = self._packer.pack(rows, self.start_unix_ns)
        try:
            yield
        finally:
            self._packed = None

    def write(self, messages: Sequence[Message], rows: Real) -> None:
        """Write messages of topics other than /ticks, and rows (n, columns) of at most one chunk of ticks.

        Both are written, or neither. Raises OutputError if either fails; messages whose ticks could not be written are
        removed from the file, unless that fails too.
        """
        self.write_messages(messages)
        try:
            self.write_ticks(rows)
        except OutputError:
            if messages:
                with contextlib.suppress(OutputError):
                    self._drop_last_chunk()
            raise

    def write_ticks(self, rows: Real) -> None:
        """Write rows (n, columns) float64 of ascending ticks, as chunks of at most `format.chunk_rows` ticks.

        Raises OutputError if the file was removed, the free space is too small, or a write fails; the chunks before the
        failed one stay in the file.
        """
        packed = self._packed or self._packer.pack(rows, self.start_unix_ns)
        for chunk in itertools.islice(packed, math.ceil(len(rows) / self._packer.chunk_rows)):
            self._check_writable()
            self.file.append_chunk(chunk)
            self.ticks += chunk.counts[format.TICKS]

    def write_messages(self, messages: Sequence[Message]) -> None:
        """Write messages of topics other than /ticks as one chunk, indexed by topic; do nothing without messages.

        Adds the ticks that overviews among the messages replace to `ticks_skipped`. Raises OutputError, with nothing
        written, if the file was removed, the free space is too small, or the write fails.
        """
        if messages:
            self._check_writable()
            self.file.append_chunk(_pack_messages(messages))
            if any(message.channel == format.OVERVIEW for message in messages):
                self._count_skipped(messages)

    def write_overview(self, messages: Sequence[Message], intervals: Intervals) -> None:
        """Write messages and intervals (n, columns, 3: minimum, maximum, mean) of omitted ticks as one chunk.

        Adds the omitted ticks to `ticks_skipped`. Raises OutputError, with nothing written, as `write_messages` does.
        """
        overview = OverviewLayout(self._columns).make_messages(intervals, self.start_unix_ns)
        self.write_messages([*messages, *overview])

    def finish(self, final_message: Callable[[int], Message], *, require_all: bool = False) -> None:
        """Write `final_message(ticks written)`, the index and the end; then give the file its final name.

        If the disk is full, the last chunks are dropped to make room, their ticks are subtracted from `ticks` and
        `ticks_skipped`, and `final_message` is called again; with `require_all`, OutputError is raised instead. Raises
        OutputError for any other failure, NotOnDisk if the file may not be on the disk. After an error the file keeps
        the name of an unfinished one, and the caller calls `close` or `discard`.
        """
        max_chunks = len(self.file)
        while not self._try_write_end(final_message, require_all):
            while len(self.file) >= max_chunks:
                self._drop_last_chunk()
            max_chunks -= 1
        self.file.publish()

    def close(self) -> None:
        """Close the file without finishing it; further calls have no effect."""
        self.file.close()

    def discard(self) -> None:
        """Close the unfinished file and remove it; one that cannot be removed stays, without an error."""
        self.file.discard()

    def _count_skipped(self, messages: Sequence[Message]) -> None:
        """Add the ticks that the overviews in a written chunk replace to `ticks_skipped`.

        `messages` are all messages of that chunk. The number is also stored for `_drop_last_chunk`: one call for each
        chunk with overviews.
        """
        payloads = [message.payload for message in messages if message.channel == format.OVERVIEW]
        count = sum(count for _, count in tick_ranges(OverviewLayout(self._columns).parse_intervals(payloads)))
        self._skipped_counts.append(count)
        self.ticks_skipped += count

    def _drop_last_chunk(self) -> None:
        """Remove the last chunk from the file, and its ticks from `ticks` or `ticks_skipped`.

        Raises OutputError, with both counts unchanged, if the file cannot be cut.
        """
        counts = self.file.drop_last_chunk()
        self.ticks -= counts.get(format.TICKS, 0)
        if counts.get(format.OVERVIEW):
            self.ticks_skipped -= self._skipped_counts.pop()

    def _try_write_end(self, final_message: Callable[[int], Message], require_all: bool) -> bool:
        """Write the final event, the index and the footer. Returns True; False on a full disk if a chunk can go.

        Raises OutputError for any other failure, and with `require_all` for a full disk too.
        """
        try:
            self.file.append_chunk(_pack_messages([final_message(self.ticks)]))
            self.file.write_end()
        except OutputError as error:
            if require_all or error.number not in DISK_FULL_ERRORS or len(self.file) <= 1:
                raise
            return False
        return True

    def _write_header(self, header: Mapping[str, Any], log_time: int, repeated: Sequence[McapRecord]) -> None:
        """Write the first chunk: schemas and channels `repeated`, then `header` with `configuration_sha256` added.

        Raises OutputError.
        """
        digest = hashlib.sha256(header.get("configuration", "").encode()).hexdigest()
        payload = json.dumps({**header, "configuration_sha256": digest}).encode()
        message = Message(format.CONFIGURATION, log_time, payload)
        self.file.append_chunk(_pack_messages([message], pack_records(repeated)))

    def _check_writable(self) -> None:
        """Raise OutputError if the file was removed or the free space is too small."""
        if not self.file.is_in_place():
            raise OutputError(f"{self.part}: this file or its folder was removed during the run", errno.ENOENT)
        self._check_space()

    def _check_space(self, room_bytes: int = 0) -> None:
        """Raise OutputError if less than `min_free_bytes` plus `room_bytes` are free; no check if both are 0."""
        required_bytes = self._min_free_bytes + room_bytes
        if required_bytes == 0:
            return
        with output_errors(self.path):
            status = os.statvfs(self.path.parent)
        free_bytes = status.f_bavail * status.f_frsize
        if free_bytes >= required_bytes:
            return
        if self._min_free_bytes == 0:
            raise OutputError(f"{self.path}: {os.strerror(errno.ENOSPC)}", errno.ENOSPC)
        requirement = f"at least {self._min_free_bytes >> 20} MiB must stay free"
        if room_bytes:
            requirement += f", and a new file needs {room_bytes >> 20} MiB"
        raise OutputError(f"{self.path}: {free_bytes >> 20} MiB are free; {requirement}", LOW_SPACE)


def _pack_messages(messages: Sequence[Message], leading_records: bytes = b"") -> PackedChunk:
    """Pack a chunk of `leading_records` and one or more messages, each in the index of its channel."""
    records, index_entries = bytearray(leading_records), {}
    for message in messages:
        times, offsets = index_entries.setdefault(message.channel, ([], []))
        times.append(message.log_time)
        offsets.append(len(records))
        records += pack_message(*message)
    content = ChunkContent(
        bytes(records),
        min(message.log_time for message in messages),
        max(message.log_time for message in messages),
        {channel: len(place[0]) for channel, place in index_entries.items()},
        {channel: pack_index(channel, *place) for channel, place in index_entries.items()},
    )
    return compress_chunk(content)
