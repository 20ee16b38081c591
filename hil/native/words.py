"""Ordered access to single words of shared memory, from Python; what compiled code has in `atomics`."""

from __future__ import annotations

import numpy as np

from rtloop.hil.native import atomics
from rtloop.hil.native.compiled import entry
from rtloop.hil.native.pointers import address_pointer, carray


@entry("uint64(intp)")
def load_acquire(address):
    """The uint64 at an address, loaded before every later load and store."""
    return atomics.load_acquire(carray(address_pointer(address), 1, np.uint64), 0)


@entry("int32(intp, uint64)")
def store_release(address, value):
    """Set the uint64 at an address, after every earlier load and store; 0."""
    atomics.store_release(carray(address_pointer(address), 1, np.uint64), 0, value)
    return 0


@entry("int32(intp, uint64, uint64)")
def exchanged(address, expected, wanted):
    """Set the uint64 at an address to `wanted` if it is `expected`, at once; 1 if it was, 0 otherwise."""
    return atomics.exchanged(carray(address_pointer(address), 1, np.uint64), 0, expected, wanted)
