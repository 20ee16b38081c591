"""Ordered access to the shared block's control words, for processes that are not the loop."""

from __future__ import annotations

from rtloop.hil.native.atomics import load_acquire, store_release
from rtloop.hil.native.compiled import jit


@jit
def load_word(words, index):
    """One control word."""
    return load_acquire(words, index)


@jit
def store_word(words, index, value):
    """Set one control word."""
    store_release(words, index, value)
