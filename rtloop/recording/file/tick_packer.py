"""Encode and compress ticks, one chunk or several at once; the bytes do not depend on the number of threads.

numpy and zstd release the interpreter's lock, so that several threads work at the same time.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from functools import cache, partial
from typing import TYPE_CHECKING

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.foundation.processors import usable_processors
from rtloop.recording.file.mcap.chunkfile import ChunkContent, PackedChunk, compress_chunk
from rtloop.recording.file.mcap.container import pack_index
from rtloop.recording.file.topics import format

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor

MAX_WORKERS = 4
"""More threads would wait for the recorder's first one, which takes the ticks out of the ring."""


class _Template(threading.local):
    """The blank records of a chunk of each thread, `records`."""

    def __init__(self, columns: Sequence[str]) -> None:
        """Make the records of a thread, at its first use there."""
        self.records = format.blank_ticks(columns, format.chunk_rows(columns))


class TickPacker:
    """Packer of the ticks of one recording into chunks of at most `chunk_rows` ticks."""

    def __init__(self, columns: Sequence[str], *, message_index: bool = False, workers: int | None = None) -> None:
        """Prepare to pack ticks with `columns`. `message_index` adds 16 bytes of index to every tick.

        `workers` is the number of threads that pack several chunks: by default one for each processor that this process
        may use, at most MAX_WORKERS.
        """
        self.chunk_rows = format.chunk_rows(columns)
        self._columns, self._message_index = columns, message_index
        self._workers = workers or _default_workers()
        self._template = _Template(columns)

    def pack(self, rows: Real, start_unix_ns: int) -> Iterator[PackedChunk]:
        """Yield rows (n, columns) float64 of ascending ticks as packed chunks, all but the last of them full.

        Ticks are logged at `start_unix_ns` plus their deadline. `rows` must not change before the last chunk is taken.
        """
        parts = [rows[start : start + self.chunk_rows] for start in range(0, len(rows), self.chunk_rows)]
        pack = partial(self._pack_chunk, start_unix_ns=start_unix_ns)
        if len(parts) <= 1 or self._workers == 1:
            return map(pack, parts)
        return _threads(self._workers).map(pack, parts)

    def _pack_chunk(self, rows: Real, start_unix_ns: int) -> PackedChunk:
        """Pack rows (n, columns) of ticks, 1 ≤ n ≤ `chunk_rows`, as one chunk."""
        count = len(rows)
        records = self._template.records[:count]
        format.fill_ticks(records, self._columns, rows, start_unix_ns)
        times, indexes = records["_log_time"], {}
        if self._message_index:
            offsets = np.arange(count) * records.dtype.itemsize
            indexes = {format.TICKS: pack_index(format.TICKS, times, offsets)}
        data = records.view(np.uint8).data
        return compress_chunk(ChunkContent(data, int(times[0]), int(times[-1]), {format.TICKS: count}, indexes))


def _default_workers() -> int:
    """Return the number of processors that this process may use, at most MAX_WORKERS."""
    return min(usable_processors(), MAX_WORKERS)


@cache
def _threads(count: int) -> ThreadPoolExecutor:
    """Return the process's pool of `count` threads that pack ticks; no thread starts before its first chunk."""
    from concurrent.futures import ThreadPoolExecutor  # A paced recorder starts without it.

    return ThreadPoolExecutor(count, "pack-ticks")
