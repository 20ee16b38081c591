"""The checksum of a chunk, folded by carry-less multiplication, against zlib's."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from rtloop.foundation.native import crc32 as module
from rtloop.foundation.native.crc32 import BLOCK_BYTES, SHORTEST_BYTES, crc32

LENGTHS = [*range(4), SHORTEST_BYTES - 1, *(SHORTEST_BYTES + n for n in range(2 * BLOCK_BYTES + 2)), 1 << 20]


@pytest.mark.parametrize("folds", [True, False])
@pytest.mark.parametrize("start", range(9))
def test_the_checksum_is_that_of_zlib(start: int, folds: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of random bytes at any address, after any other bytes; with and without a processor that can fold them."""
    if not folds:
        monkeypatch.setattr(module, "_fold_function", lambda: None)
    random = np.random.default_rng(start)
    data = memoryview(random.bytes(start + LENGTHS[-1]))[start:]
    for length in LENGTHS:
        for value in (0, 1, 0xFFFFFFFF, int(random.integers(1 << 32))):
            assert crc32(data[:length], value) == zlib.crc32(data[:length], value)


def test_the_checksum_continues_over_parts() -> None:
    data = np.random.default_rng(1).bytes(10_000)
    value = 0
    for part in (data[:1], data[1:2000], data[2000:7777], data[7777:]):
        value = crc32(part, value)
    assert value == zlib.crc32(data)


@pytest.mark.parametrize("byte", [0, 17, 63, 64, 1000, 1023, 1087, 1090])
def test_each_bit_counts(byte: int) -> None:
    data = bytearray(1091)
    before = crc32(data)
    for bit in range(8):
        data[byte] ^= 1 << bit
        assert crc32(data) != before
        data[byte] ^= 1 << bit
