"""The ring delivers whole slots in order, and the reader knows how many it lost."""

from __future__ import annotations

import ctypes
import threading

import numba
import numpy as np
import pytest

from rtloop.engine.ring import ONE, Ring, _drain, claim, drain, publish
from rtloop.foundation.native.atomics import load_acquire

COLUMNS = 40


def new_ring(slots: int = 8) -> Ring:
    return Ring(np.zeros(1, np.uint64), np.zeros(slots, np.uint64), np.zeros((slots, COLUMNS)))


def write(ring: Ring, first: int, count: int) -> None:
    """Publish `count` slots from position `first` on, each filled with its position."""
    for position in range(first, first + count):
        ring.slots[claim(ring, np.uint64(position))] = position
        publish(ring, np.uint64(position))


def read(ring: Ring, cursor: int, room: int = 100) -> tuple[list[float], int, int]:
    """Return the values of the slots, the first position and the number of lost slots; a torn slot fails the test."""
    out = np.full((room, COLUMNS), np.nan)
    copied, first, lost = drain(ring, cursor, out)
    assert np.all(out[:copied] == out[:copied, :1])
    return out[:copied, 0].tolist(), int(first), int(lost)


@pytest.fixture
def ring() -> Ring:
    """Return an empty ring of 8 slots."""
    return new_ring()


def test_in_order_and_once(ring):
    assert read(ring, 0) == ([], 0, 0)
    write(ring, 0, 5)
    assert read(ring, 0) == ([0, 1, 2, 3, 4], 0, 0)
    assert read(ring, 3) == ([3, 4], 3, 0)  # every reader has its own cursor
    assert read(ring, 5) == ([], 5, 0)
    write(ring, 5, 8)
    assert read(ring, 5, room=3) == ([5, 6, 7], 5, 0)
    assert read(ring, 8) == ([8, 9, 10, 11, 12], 8, 0)


def test_a_lapped_reader_knows_what_it_lost(ring):
    write(ring, 0, 21)
    assert read(ring, 3) == ([13, 14, 15, 16, 17, 18, 19, 20], 13, 10)


def test_a_slot_that_is_being_written_is_not_read(ring):
    write(ring, 0, 8)
    ring.slots[claim(ring, np.uint64(8))][: COLUMNS // 2] = 8  # a torn slot: position 0 is half overwritten
    assert read(ring, 0) == ([1, 2, 3, 4, 5, 6, 7], 1, 1)
    publish(ring, np.uint64(8))
    ring.slots[0] = 8
    assert read(ring, 8) == ([8], 8, 0)


def test_a_reader_may_come_late_to_a_long_run(ring):
    start = (1 << 40) + 3
    write(ring, start, 10)
    assert read(ring, 7) == ([*range(start + 2, start + 10)], start + 2, start + 2 - 7)


@numba.njit(nogil=True)
def hammer(ring, stop):
    """Publish slots without a pause, each filled with its position, until `stop` is set."""
    position = np.uint64(0)
    while load_acquire(stop, 0) == np.uint64(0):
        slot = claim(ring, position)
        for i in range(ring.slots.shape[1]):
            ring.slots[slot, i] = float(position)
        publish(ring, position)
        position += ONE


_POINTERS, _NUMBER = [ctypes.c_ssize_t] * 3, ctypes.c_int64
DRAIN = ctypes.CFUNCTYPE(
    ctypes.c_int32, *_POINTERS[:2], *_POINTERS, _NUMBER, _NUMBER, ctypes.c_ssize_t, _NUMBER, ctypes.c_ssize_t
)(_drain.address)
"""The machine code that `drain` calls; only compiled code calls it often enough to meet the writer."""


@numba.njit(nogil=True)
def watch(ring, out, needed):
    """Drain until `needed` slots are read; return the numbers of wrong values, of lost slots and of lossy drains."""
    cursor, read_count, wrong_values, lost, laps = np.uint64(0), 0, 0, 0, 0
    first, copied, raised = np.zeros(1, np.uint64), np.zeros(1, np.int64), np.zeros(1, np.int64)
    while read_count < needed:
        first[0] = cursor
        DRAIN(
            copied.ctypes.data, raised.ctypes.data, ring.head.ctypes.data, ring.marks.ctypes.data,
            ring.slots.ctypes.data, ring.marks.size, ring.slots.strides[0],
            out.ctypes.data, out.shape[0], first.ctypes.data,
        )  # fmt: skip
        lost += np.int64(first[0] - cursor)
        laps += 1 if first[0] > cursor else 0
        for i in range(copied[0]):
            for j in range(out.shape[1]):
                if out[i, j] != float(first[0] + np.uint64(i)):
                    wrong_values += 1
        cursor = first[0] + np.uint64(copied[0])
        read_count += copied[0]
    return wrong_values, lost, laps


@pytest.mark.parametrize("slots", [4, 64])
def test_no_torn_read_under_a_writer_that_never_waits(slots):
    ring, stop, out = new_ring(slots), np.zeros(1, np.uint64), np.empty((64, COLUMNS))
    stopped = np.ones(1, np.uint64)
    hammer(ring, stopped)  # compiles
    write(ring, 0, 1)
    watch(ring, out, 1)
    ring = new_ring(slots)
    writer = threading.Thread(target=hammer, args=(ring, stop))
    writer.start()
    try:
        wrong_values, lost, laps = watch(ring, out, 100_000)
    finally:
        stop[0] = 1
        writer.join()
    assert (wrong_values, lost > 0, laps > 0) == (0, True, True)
