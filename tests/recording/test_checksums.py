"""The checksum of chunks and files is zlib's, whichever library computes it."""

from __future__ import annotations

import subprocess
import sys
import zlib

import numpy as np
import pytest

from rtloop.recording.file.mcap.checksum import crc32

LENGTHS = [*range(300), 1023, 1024, 1025, 1 << 20]


@pytest.mark.parametrize("start", range(9))
def test_the_checksum_is_that_of_zlib(start: int) -> None:
    """The bytes are random, at any address, after a checksum of any other bytes."""
    random = np.random.default_rng(start)
    data = memoryview(random.bytes(start + LENGTHS[-1]))[start:]
    for length in LENGTHS:
        for value in (0, 0xFFFFFFFF, int(random.integers(1 << 32))):
            assert crc32(data[:length], value) == zlib.crc32(data[:length], value)


def test_without_the_library_zlib_computes_it() -> None:
    module = "rtloop.recording.file.mcap.checksum"
    program = f"import sys; sys.modules['isal'] = None; import {module} as c; print(c.crc32(b'x'))"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert int(result.stdout) == zlib.crc32(b"x")
