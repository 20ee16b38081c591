"""A broadcast ring in shared memory: one writer that never blocks, any number of readers, each with its own cursor.

Per slot: invalidate, fence, payload, release the position (Lamport 1977; Boehm 2012, "Can seqlocks get along with
programming language memory models?"). A reader checks the position before and after its copy, so a copy that the
writer lapped is never taken for good, and the reader knows which positions it lost.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rtloop.hil.native.atomics import fence_acquire, fence_release, load_acquire, store_release
from rtloop.hil.native.compiled import jit

BUSY = np.uint64(0xFFFFFFFFFFFFFFFF)
ONE = np.uint64(1)


class Ring(NamedTuple):
    """`head` (1,) uint64: positions published; `marks` (n,) uint64: position + 1 of each slot; `slots` (n, …)."""

    head: Any
    marks: Any
    slots: Any


@jit
def slot_of(ring, position):
    """Slot of a position; the number of slots is a power of two."""
    return np.int64(position & np.uint64(ring.marks.shape[0] - 1))


@jit
def claim(ring, position):
    """Slot to fill for `position` (uint64): its old content is invalid from here on. Writer only."""
    slot = slot_of(ring, position)
    store_release(ring.marks, slot, BUSY)
    fence_release()
    return slot


@jit
def publish(ring, position):
    """Make the filled slot of `position` visible to all readers. Writer only."""
    store_release(ring.marks, slot_of(ring, position), position + ONE)
    store_release(ring.head, 0, position + ONE)


@jit
def drain(ring, cursor, out):
    """Copy what is readable from position `cursor` on into `out` (m, …), whole slots, oldest first.

    Returns (copied, first, lost): `out[:copied]` holds positions first … first + copied − 1, without a hole, and
    `lost` positions from `cursor` to `first` were overwritten before they could be read. The next cursor is
    first + copied.
    """
    capacity = np.uint64(ring.marks.shape[0])
    head = load_acquire(ring.head, 0)
    first = cursor
    if head > first + capacity:
        first = head - capacity
    copied = 0
    while copied < out.shape[0] and first + np.uint64(copied) < head:
        position = first + np.uint64(copied)
        slot = slot_of(ring, position)
        intact = load_acquire(ring.marks, slot) == position + ONE
        if intact:
            out[copied] = ring.slots[slot]
            fence_acquire()
            intact = load_acquire(ring.marks, slot) == position + ONE
        if intact:
            copied += 1
        elif copied > 0:
            break
        else:
            head = load_acquire(ring.head, 0)
            first = max(first + ONE, head - min(head, capacity) + ONE)
    return copied, first, first - cursor
