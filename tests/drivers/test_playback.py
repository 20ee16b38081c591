"""The playback driver returns the recorded rows, bit for bit, and then ends the run."""

from __future__ import annotations

import ctypes

import numpy as np

from rtloop.drivers.playback import TIMING_COLUMNS, Playback

FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.POINTER(ctypes.c_double))
VALUES = 5
GUARD = 777.0


def make_rows(count: int, seed: int) -> np.ndarray:
    """Return random rows of times, status and values; the first row holds NaN, −0 and infinity."""
    tape = np.random.default_rng(seed).normal(0, 1e3, (count, TIMING_COLUMNS + 1 + VALUES))
    tape[:, TIMING_COLUMNS] = np.arange(count) - 3
    tape[0, -3:] = np.nan, -0.0, np.inf
    return tape


class Reader:
    """A loop's side of the playback driver, with a guard value behind each array."""

    def __init__(self, tape: Playback) -> None:
        self.pointers = tape.pointers()
        self.timing, self.values = (ctypes.c_double * 5)(*[GUARD] * 5), (ctypes.c_double * 6)(*[GUARD] * 6)

    def rows(self, count: int) -> bytes:
        """Return the bytes of `count` rows."""
        return np.array([self.tick() for _ in range(count)]).tobytes()

    def tick(self) -> np.ndarray | None:
        """Play a row by wait, read and write, as the loop does, and return the row; None after the last one."""
        context = self.pointers.context
        if FUNCTION(self.pointers.wait)(context, self.timing) != 0:
            return None
        status = FUNCTION(self.pointers.read)(context, self.values)
        assert FUNCTION(self.pointers.write)(context, self.values) == 0
        assert self.timing[TIMING_COLUMNS] == self.values[VALUES] == GUARD
        return np.array([*self.timing[:TIMING_COLUMNS], status, *self.values[:VALUES]])


def test_every_row_is_played_once_and_then_the_run_ends():
    tape, recorded = Playback(), make_rows(7, 1)
    tape.load(recorded)
    reader = Reader(tape)
    assert reader.rows(7) == recorded.tobytes()
    assert reader.tick() is reader.tick() is None


def test_segments_follow_each_other():
    tape = Playback()
    reader = Reader(tape)
    assert reader.tick() is None
    for seed in range(3):
        recorded = make_rows(4, seed)
        tape.load(recorded)
        assert reader.rows(4) == recorded.tobytes()


def test_any_layout_of_the_array_is_accepted():
    tape, recorded = Playback(), make_rows(6, 2)
    tape.load(np.asfortranarray(recorded)[::2])
    assert Reader(tape).rows(3) == recorded[::2].tobytes()
