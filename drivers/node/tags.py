"""Tags of frames: SipHash-2-4 with 64 bits (Aumasson and Bernstein 2012), for compiled code and for Python."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rtloop.foundation.native.compiled import cfunc, jit, jit_rare
from rtloop.foundation.native.pointers import add_words, address_pointer, carray, load_word

TAG_BYTES, KEY_BYTES = 8, 16
STATE_BYTES = 12
"""Bytes of boot, opening and turn, which a tag covers and no frame contains."""
_INITIAL = tuple(map(np.uint64, (0x736F6D6570736575, 0x646F72616E646F6D, 0x6C7967656E657261, 0x7465646279746573)))
_0, _1, _2, _3 = _INITIAL
_FINAL = np.uint64(0xFF)
_8, _13, _16, _17, _21, _32, _56, _64 = map(np.uint64, (8, 13, 16, 17, 21, 32, 56, 64))


class Seal(NamedTuple):
    """What the tag of a frame depends on besides the frame: the key, None without one, boot, opening and turn."""

    key: bytes | None
    boot: int
    opening: int
    turn: int = 0


@jit
def _rotate(word, bits):
    """Return a word of 64 bits, rotated to the left."""
    return (word << bits) | (word >> (_64 - bits))


@jit
def _rounds(v0, v1, v2, v3, count):
    """Return the state of four words after `count` rounds of SipHash."""
    for _ in range(count):
        v0, v2 = add_words(v0, v1), add_words(v2, v3)
        v1, v3 = _rotate(v1, _13) ^ v0, _rotate(v3, _16) ^ v2
        v0, v2 = add_words(_rotate(v0, _32), v3), add_words(v2, v1)
        v1, v3 = _rotate(v1, _17) ^ v2, _rotate(v3, _21) ^ v0
        v2 = _rotate(v2, _32)
    return v0, v1, v2, v3


@jit_rare
def siphash(key_low, key_high, address, length):
    """Return SipHash-2-4 (uint64) of the `length` bytes at `address`; the key's words are little-endian uint64."""
    v0, v1, v2, v3 = key_low ^ _0, key_high ^ _1, key_low ^ _2, key_high ^ _3
    words = length // 8
    tail = carray(address_pointer(address + 8 * words), length % 8, np.uint8)
    for i in range(words + 1):
        if i < words:
            word = load_word(address + 8 * i)
        else:
            word = np.uint64(length & 0xFF) << _56
            for j in range(length % 8):
                word |= np.uint64(tail[j]) << (_8 * np.uint64(j))
        v0, v1, v2, v3 = _rounds(v0, v1, v2, v3 ^ word, 2)
        v0 ^= word
    v0, v1, v2, v3 = _rounds(v0, v1, v2 ^ _FINAL, v3, 4)
    return v0 ^ v1 ^ v2 ^ v3


@jit
def write_tag(key_low, key_high, address, length, boot, opening, turn):
    """Write the tag of the `length` bytes at `address` behind them; 4 bytes more, the place of the check, are lost."""
    place = carray(address_pointer(address + length), 3, np.uint32)
    place[0], place[1], place[2] = boot, opening, turn  # The tag covers them, and then takes their place.
    tag = siphash(key_low, key_high, address, length + STATE_BYTES)
    place[0], place[1] = tag & np.uint64(0xFFFFFFFF), tag >> _32


@cfunc("int32(uint64, uint64, intp, int64, int64, int64, int64)")
def write_tag_from_python(key_low, key_high, address, length, boot, opening, turn):
    """Call `write_tag` with integers of Python, and return 0."""
    write_tag(key_low, key_high, address, length, boot, opening, turn)
    return 0


def key_words(key: bytes) -> tuple[int, int]:
    """Return the two words of a key, as `siphash` takes them."""
    return int.from_bytes(key[:8], "little"), int.from_bytes(key[8:], "little")


def tag_of(content: bytes, seal: Seal) -> bytes:
    """Return the tag (8 bytes) of a frame that begins with `content`; zeros without a key."""
    if seal.key is None:
        return bytes(TAG_BYTES)
    buffer = np.frombuffer(bytearray(content + bytes(STATE_BYTES)), np.uint8)
    write_tag_from_python(*key_words(seal.key), buffer.ctypes.data, len(content), *seal[1:])
    return buffer[len(content) :][:TAG_BYTES].tobytes()
