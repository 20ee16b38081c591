"""Session of an unpaced run: threads pack ticks into chunks while the session drains the ticks after them.

Order and bytes of the file do not depend on the number of threads.
"""

from __future__ import annotations

import os
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

from rtloop.engine.memory import SharedBlock
from rtloop.foundation.arrays import Real
from rtloop.recording.capture.pending import PendingEntry, count_pending
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.recording.capture.run_files import Options
from rtloop.recording.capture.session import Session
from rtloop.recording.file.mcap.chunkfile import PackedChunk
from rtloop.recording.file.writer import TickPacker

MAX_THREADS = 3
"""More gain nothing: three pack as many ticks as the loop computes."""


class PackedTicks(NamedTuple):
    """Rows (n, columns) of ticks, the messages that precede them, and the rows packed by a thread."""

    rows: Real
    entries: list[PendingEntry]
    packed: Future[PackedChunk]


class UnpacedSession(Session):
    """Session whose ticks wait in order, at most one chunk for each thread, until they are packed and written."""

    def __init__(
        self,
        block: SharedBlock,
        path: Path,
        header: dict[str, Any],
        options: Options,
        names: RequesterNames | None = None,
        threads: int | None = None,
    ) -> None:
        """Begin as `Session` does, for a header that is not `paced`.

        `threads` ≥ 1 pack the ticks; None: one fewer than there are processors, and at most MAX_THREADS. Raises
        OutputError as `Session` does.
        """
        self._waiting: deque[PackedTicks] = deque()
        self._threads = threads or max(1, min(MAX_THREADS, len(os.sched_getaffinity(0)) - 1))
        packers = [TickPacker(header["columns"], options.message_index) for _ in range(self._threads + 1)]
        self._next_packer = cycle(packers)  # Of so many chunks that are packed or wait, each has its own.
        self._pool = ThreadPoolExecutor(self._threads)
        super().__init__(block, path, header, options, names)

    def _write(self, count: int, entries: list[PendingEntry]) -> None:
        """Let a thread pack the first `count` rows and drop them from the buffer; write what has waited longest.

        Without rows, write `entries` at once, after all ticks that wait.
        """
        if not count:
            self._write_waiting()
            super()._write(count, entries)
            return
        self._last_write_s = time.monotonic()
        rows = self._buffer.first_rows(count).copy()
        self._buffer.drop(count)
        packed = self._pool.submit(next(self._next_packer).pack, rows, self._start_unix_ns())
        self._waiting.append(PackedTicks(rows, entries, packed))
        while len(self._waiting) > self._threads:
            self._write_oldest()

    def _write_oldest(self) -> None:
        """Write the ticks that wait longest, with their messages; a failed write loses them, as in `Session`."""
        ticks = self._waiting.popleft()
        self._write_or_lose(ticks.rows, ticks.entries, ticks.packed.result())

    def _write_waiting(self) -> None:
        """Write all ticks that wait."""
        while self._waiting:
            self._write_oldest()

    def _write_remaining(self, result: str) -> None:
        """Write all ticks and messages; `result` is not used."""
        super()._write_remaining(result)
        self._write_waiting()
        self._pool.shutdown()

    def _is_file_due(self, tick: int) -> bool:
        """Whether a file should begin at the snapshot of `tick`; writes all ticks that wait if its size decides."""
        if self._options.rotate_bytes is not None:
            self._write_waiting()
        return super()._is_file_due(tick)

    def _rotate(self, tick: int) -> None:
        """Write all ticks that wait and, unless that fails, begin another file at `tick`."""
        self._write_waiting()
        if not self.failure:
            super()._rotate(tick)

    def _count_pending(self, channel: int) -> int:
        """Count the unwritten messages with channel id `channel` from the rings, without the recorder's own events."""
        return super()._count_pending(channel) + sum(count_pending(ticks.entries, channel) for ticks in self._waiting)
