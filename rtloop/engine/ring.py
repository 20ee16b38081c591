"""Broadcast ring in shared memory: one writer that never blocks, any number of readers, each with a cursor.

Per slot: invalidate, fence, payload, release the position (Lamport 1977; Boehm 2012, "Can seqlocks get along with
programming language memory models?"). A reader checks the position before and after its copy, so a copy that the
writer lapped is discarded, and the reader knows which positions it lost.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.foundation.native.atomics import fence_acquire, fence_release, load_acquire, store_release
from rtloop.foundation.native.compiled import jit, python_entry
from rtloop.foundation.native.pointers import address_pointer, carray, copy_bytes

BUSY = np.uint64(0xFFFFFFFFFFFFFFFF)
ONE = np.uint64(1)


class Ring(NamedTuple):
    """`head` (1,) uint64: positions published; `marks` (n,) uint64: position + 1 of each slot; `slots` (n, …)."""

    head: npt.NDArray[np.uint64]
    marks: npt.NDArray[np.uint64]
    slots: Any


@jit
def slot_index(ring, position):
    """Return the index of the slot of `position`, a uint64."""
    return _wrapped_position(ring.marks.shape[0], position)


@jit
def _wrapped_position(count, position):
    """Return the position modulo `count`, a power of two."""
    return np.int64(position & np.uint64(count - 1))


@jit
def claim(ring, position):
    """Invalidate the slot of `position` (uint64) and return its index; the caller fills the slot. Writer only."""
    slot = slot_index(ring, position)
    store_release(ring.marks, slot, BUSY)
    fence_release()
    return slot


@jit
def publish(ring, position):
    """Make the filled slot of `position` visible to all readers. Writer only."""
    store_release(ring.marks, slot_index(ring, position), position + ONE)
    store_release(ring.head, 0, position + ONE)


def drain(ring: Ring, cursor: int, out: npt.NDArray[np.generic]) -> tuple[int, int, int]:
    """Copy all readable slots from position `cursor` on into `out` (m, …), oldest first.

    Returns (copied, first, lost): `out[:copied]` holds positions first … first + copied − 1, without a hole, and
    `lost` positions from `cursor` to `first` were overwritten before. The next cursor is first + copied; `copied` is 0
    if nothing is readable. Raises ValueError for an `out` that is not contiguous or does not fit the slots.
    """
    slots, first = ring.slots, np.array([cursor], np.uint64)
    if out.dtype != slots.dtype or out.shape[1:] != slots.shape[1:] or not out.flags.c_contiguous:
        raise ValueError(
            f"the array `out`, one row for each slot, has rows of shape {out.shape[1:]} and type {out.dtype}; allowed: "
            f"a contiguous array with rows of shape {slots.shape[1:]} and type {slots.dtype}"
        )
    copied = _drain(
        ring.head.ctypes.data, ring.marks.ctypes.data, slots.ctypes.data, len(slots), slots.strides[0],
        out.ctypes.data, len(out), first.ctypes.data,
    )  # fmt: skip
    return copied, int(first[0]), int(first[0]) - int(cursor)


@python_entry("int64(intp, intp, intp, int64, int64, intp, int64, intp)")
def _drain(head_address, marks_address, slots, count, slot_bytes, out, room, first_address):
    """Copy slots as `drain` does, from the position at `first_address` on; return the number of slots copied.

    The word at `first_address` (uint64) becomes the position of the first copy: overwritten positions are skipped.
    `count` and `room` are the slots of ring and `out`, `slot_bytes` the bytes of each; addresses are in bytes.
    """
    head_word = carray(address_pointer(head_address), 1, np.uint64)
    marks = carray(address_pointer(marks_address), count, np.uint64)
    first_word = carray(address_pointer(first_address), 1, np.uint64)
    capacity, first = np.uint64(count), first_word[0]
    head = load_acquire(head_word, 0)
    if head > first + capacity:
        first = head - capacity
    copied = 0
    while copied < room and first + np.uint64(copied) < head:
        position = first + np.uint64(copied)
        slot = _wrapped_position(count, position)
        intact = load_acquire(marks, slot) == position + ONE
        if intact:
            copy_bytes(out + copied * slot_bytes, slots + slot * slot_bytes, slot_bytes)
            fence_acquire()
            intact = load_acquire(marks, slot) == position + ONE
        if intact:
            copied += 1
        elif copied > 0:
            break
        else:
            head = load_acquire(head_word, 0)
            first = max(first + ONE, head - min(head, capacity) + ONE)
    first_word[0] = first
    return copied
