"""A pipe that nobody reads."""

from __future__ import annotations

import os


def fill(writing: int) -> int:
    """Write until nothing more goes in; the bytes that did. The descriptor blocks again afterwards."""
    os.set_blocking(writing, False)
    size = 0
    while True:
        try:
            size += os.write(writing, b"x" * 4096)
        except BlockingIOError:
            os.set_blocking(writing, True)
            return size
