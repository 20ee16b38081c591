"""Messages between a process and its limited process, on pipes: a 64-bit length, then the bytes."""

from __future__ import annotations

import struct
from typing import IO

LENGTH = struct.Struct("<Q")


def write_frame(pipe: IO[bytes], data: bytes) -> None:
    """Write all of `data` behind its length, in as many writes as the pipe needs.

    Raises BrokenPipeError if the reader has closed the pipe.
    """
    remaining = memoryview(LENGTH.pack(len(data)) + data)
    while remaining:
        remaining = remaining[pipe.write(remaining) :]


def read_frame(pipe: IO[bytes]) -> bytes | None:
    """Return the next message without its length; None at the end of the pipe, even where this end cuts off a length.

    A message that the end of the pipe cuts off is returned incomplete.
    """
    length = pipe.read(LENGTH.size)
    return pipe.read(LENGTH.unpack(length)[0]) if len(length) == LENGTH.size else None
