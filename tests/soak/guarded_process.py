"""The loop's process with a canary before and behind every record of the law: `python -m tests.soak.guarded_process`.

When the loop has ended it reports how many bytes of the canaries are no longer what they were.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from rtloop.engine import process
from rtloop.kernel import memory
from rtloop.kernel.layout import LINE_BYTES, Records

CANARY_BYTES, CANARY = 1 << 16, 0xA5
_guarded: list[tuple[np.ndarray[Any, Any], int, int]] = []


def guarded_records(dtype: np.dtype[Any], count: int) -> Records:
    """As `memory.records`, between two canaries."""
    room = np.full(2 * CANARY_BYTES + count * dtype.itemsize + LINE_BYTES, CANARY, np.uint8)
    begin = CANARY_BYTES + -(room.ctypes.data + CANARY_BYTES) % LINE_BYTES
    end = begin + count * dtype.itemsize
    room[begin:end] = 0
    _guarded.append((room, begin, end))
    return room[begin:end].view(dtype).view(np.recarray)


def guarded() -> int:
    """Allocations of records so far, each between canaries of its own."""
    return len(_guarded)


def broken() -> int:
    """Bytes of all canaries that something wrote to."""
    return sum(int(np.count_nonzero(np.delete(room, np.s_[begin:end]) != CANARY)) for room, begin, end in _guarded)


@contextmanager
def guarding() -> Iterator[None]:
    """Records that are made meanwhile have canaries, and are kept for ever."""
    memory.new_records, usual = guarded_records, memory.new_records
    try:
        yield
    finally:
        memory.new_records = usual


def main() -> int:
    """The loop's process, and then the canaries."""
    with guarding():
        code = process.main()
    process.report("canaries", records=guarded(), broken=broken())
    return code


if __name__ == "__main__":
    sys.exit(main())
