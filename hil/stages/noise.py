"""Gaussian-like white noise from integer arithmetic: equal in bits on every machine, one 64-bit word of state.

Three steps of xorshift64 (Marsaglia 2003, the triple 13, 7, 17) give twelve 16-bit uniforms k_i. Their sum has the
mean 12·32767.5 = 393210 and the variance 12·(65536² − 1)/12 = 2³² − 1, so that (Σ k_i − 393210) / √(2³² − 1) has
mean 0 and variance 1: the Irwin-Hall distribution. It never leaves ±6 and its excess kurtosis is −0.1: close to a
Gaussian within ±3, too thin beyond, as a sensor that clips is. No logarithm, no sine: libm differs between machines.
"""

from __future__ import annotations

import hashlib

import numpy as np

from rtloop.foundation.native.compiled import jit, jit_inline

COEFFICIENTS: list[tuple[str, str]] = []
STATE = [("noise_word", "u8")]

_SHIFTS = np.uint64(13), np.uint64(7), np.uint64(17)
_16, _32 = np.uint64(16), np.uint64(32)
_LANES = np.uint64(0x0000_FFFF_0000_FFFF)
_LOW = np.uint64(0xFFFF_FFFF)
_ZERO = np.uint64(0)
_MEAN = 393210.0
_DEVIATION = float(np.sqrt(2.0**32 - 1.0))


def seed_word(seed: int, stream: str) -> int:
    """Return the first state of the stream named `stream`, never 0 (where xorshift would stay).

    A stream depends on seed and name only. The streams of a seed start at pseudo-random places (SHA-256) of one cycle
    of length 2⁶⁴ − 1, so in all likelihood far apart.
    """
    digest = hashlib.sha256(f"{seed}/{stream}".encode()).digest()
    return int.from_bytes(digest[:8], "little") or 1


@jit_inline
def next_word(word):
    """Return the next state of xorshift64."""
    word = word ^ (word << _SHIFTS[0])
    word = word ^ (word >> _SHIFTS[1])
    return word ^ (word << _SHIFTS[2])


@jit
def draw_normal(word):
    """Return a random number of mean 0 and variance 1, and the generator's state three steps after `word`, a uint64."""
    lanes = _ZERO
    for _ in range(3):
        word = next_word(word)
        # Two sums side by side in one word; six uniforms of 16 bits cannot overflow a lane of 32.
        lanes = lanes + (word & _LANES) + ((word >> _16) & _LANES)
    total = (lanes & _LOW) + (lanes >> _32)
    return (float(total) - _MEAN) / _DEVIATION, word
