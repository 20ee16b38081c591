"""Messages between a process and the limited one beside it: bytes behind their length, on pipes."""

from __future__ import annotations

import struct
from typing import IO

LENGTH = struct.Struct("<Q")


def write_frame(pipe: IO[bytes], data: bytes) -> None:
    """Write all of `data`, whatever a single write takes."""
    remaining = memoryview(LENGTH.pack(len(data)) + data)
    while remaining:
        remaining = remaining[pipe.write(remaining) :]


def read_frame(pipe: IO[bytes]) -> bytes | None:
    """The next message; None at the end of the pipe."""
    length = pipe.read(LENGTH.size)
    return pipe.read(LENGTH.unpack(length)[0]) if len(length) == LENGTH.size else None
