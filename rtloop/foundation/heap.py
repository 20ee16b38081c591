"""Heap of the C library: freed memory stays in the process, for its next arrays."""

from __future__ import annotations

import ctypes

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
KEPT_BYTES, LARGEST_HEAP_BYTES = 64 << 20, 32 << 20


def keep_freed_memory() -> None:
    """Keep up to KEPT_BYTES of freed memory in this process, and in processes that it forks later, for new arrays.

    By default, the GNU C library returns an array of a megabyte to the system when it is freed, and a new array of that
    size causes a page fault for each 4 KiB. All these faults were a third of the time of reading a recording. An array
    larger than LARGEST_HEAP_BYTES is still returned. Without the GNU C library, nothing changes.
    """
    try:
        set_option = ctypes.CDLL(None).mallopt
    except (AttributeError, TypeError, OSError):  # musl, Windows
        return
    set_option(M_MMAP_THRESHOLD, LARGEST_HEAP_BYTES)
    set_option(M_TRIM_THRESHOLD, KEPT_BYTES)
