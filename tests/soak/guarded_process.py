"""The loop's process with a canary before and after every record of the law: `python -m tests.soak.guarded_process`.

When the loop has ended, the process reports how many canary bytes were overwritten.
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
_buffers: list[tuple[np.ndarray[Any, Any], int, int]] = []
"""Each buffer with the first byte and the end of its records; all other bytes are canaries."""


def new_guarded_records(dtype: np.dtype[Any], count: int) -> Records:
    """Return zeroed records as `memory.new_records` does, between two canaries."""
    buffer = np.full(2 * CANARY_BYTES + count * dtype.itemsize + LINE_BYTES, CANARY, np.uint8)
    begin = CANARY_BYTES + -(buffer.ctypes.data + CANARY_BYTES) % LINE_BYTES
    end = begin + count * dtype.itemsize
    buffer[begin:end] = 0
    _buffers.append((buffer, begin, end))
    return buffer[begin:end].view(dtype).view(np.recarray)


def guarded_count() -> int:
    """Return the number of allocations of records so far, each between two canaries."""
    return len(_buffers)


def overwritten_bytes() -> int:
    """Return the number of canary bytes that were overwritten."""
    return sum(int(np.count_nonzero(np.delete(buffer, np.s_[begin:end]) != CANARY)) for buffer, begin, end in _buffers)


@contextmanager
def guard_records() -> Iterator[None]:
    """Allocate records between canaries within the context; their buffers are never freed."""
    memory.new_records, original = new_guarded_records, memory.new_records
    try:
        yield
    finally:
        memory.new_records = original


def main() -> int:
    """Run the loop's process, then report the canaries; return the exit code of the loop."""
    with guard_records():
        code = process.main()
    process.report("canaries", records=guarded_count(), broken=overwritten_bytes())
    return code


if __name__ == "__main__":
    sys.exit(main())
