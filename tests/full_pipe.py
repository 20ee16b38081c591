"""A pipe without a reader at work."""

from __future__ import annotations

import os


def fill(writing: int) -> int:
    """Write to the pipe until it is full; return the number of bytes. The descriptor blocks again afterwards."""
    os.set_blocking(writing, False)
    size = 0
    while True:
        try:
            size += os.write(writing, b"x" * 4096)
        except BlockingIOError:
            os.set_blocking(writing, True)
            return size
