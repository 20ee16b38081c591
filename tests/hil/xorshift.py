"""Marsaglia's xorshift64 (2003; 13, 7, 17) in Python's integers."""

from __future__ import annotations

from collections.abc import Iterator

WORDS = 2**64


def xorshift64(word: int) -> Iterator[int]:
    """Yield the states of the generator that follow the state `word`."""
    while True:
        word ^= (word << 13) % WORDS
        word ^= word >> 7
        word ^= (word << 17) % WORDS
        yield word
