"""Evidence of a board about its outputs: lowest and highest voltage, largest step, largest change within a millisecond.

A controller dates each write in the card's memory as it makes it. The board believes such a date only between two of
its own looks: the write is younger than the look that did not see it yet, and older than the look that did. Dates
never run backwards. A board that looks often therefore needs no trust in the controller's dates, and a board that
stands still neither invents a change, for the writes that it finds keep their own dates, nor hides one.

An output holds voltage v_i from t_i to t_(i+1). The change within a window is the largest |v_j − v_i|, i < j, with
t_j − t_(i+1) <= WINDOW_NS: two voltages that the output had at two instants no further apart than the window.
"""

from __future__ import annotations

import numpy as np

from rtloop.hil.native.compiled import jit

WINDOW_NS = 1_000_000
LEVELS = 1024
"""Voltages of an output that are remembered. More within one window are not judged but counted as unseen."""
SEEN = np.dtype(
    [("lowest_v", np.float64), ("highest_v", np.float64), ("written_v", np.float64), ("largest_step_v", np.float64),
     ("largest_window_v", np.float64), ("levels", np.int64), ("last_v", np.float64), ("moved_ns", np.int64),
     ("true_position_um", np.float64), ("largest_position_um", np.float64)]
)  # fmt: skip
"""Evidence about one output.

`written_v` is the voltage of the newest write, `levels` how often it changed. `largest_step_v` is the largest step
from one write to the next, `largest_window_v` the largest change within WINDOW_NS. `last_v` is the voltage at the
output, which differs from `written_v` while the output is stuck; `moved_ns` is when it last changed, in ns of
CLOCK_MONOTONIC.
"""
PAST = np.dtype([("volts", np.float64), ("from_ns", np.int64)])
"""A voltage that an output had, and since when; before the first write 0 V, for ever."""


@jit
def see_write(seen, past, volts, written_ns, follows):
    """Judge one write to an output; returns 1 if so many writes fell into its window that it cannot be judged, else 0.

    `past` (LEVELS,) holds the output's voltages, number i at i modulo LEVELS. Where `follows` is not set, the output
    is stuck, and the write does not move it.
    """
    if volts == seen.written_v:
        return 0
    newest = seen.levels
    written_ns = max(written_ns, past[newest % LEVELS].from_ns)
    is_unjudged = _judge(seen, past, volts, written_ns)
    seen.levels = newest + 1
    past[seen.levels % LEVELS].volts = volts
    past[seen.levels % LEVELS].from_ns = written_ns
    seen.written_v = volts
    seen.lowest_v = min(seen.lowest_v, volts)
    seen.highest_v = max(seen.highest_v, volts)
    if follows:
        move(seen, volts, written_ns)
    return is_unjudged


@jit
def _judge(seen, past, volts, written_ns):
    """Compare a new voltage with those that the output had within the window; returns 1 if not all are remembered."""
    seen.largest_step_v = max(seen.largest_step_v, abs(volts - seen.written_v))
    i, first = seen.levels, max(seen.levels - LEVELS + 1, 0)
    while True:
        level = past[i % LEVELS]
        seen.largest_window_v = max(seen.largest_window_v, abs(volts - level.volts))
        if i == 0 or written_ns - level.from_ns > WINDOW_NS:
            return 0
        if i == first:
            return 1
        i -= 1


@jit
def move(seen, volts, now_ns):
    """Note that the output itself is at `volts` since `now_ns`."""
    if volts != seen.last_v:
        seen.last_v, seen.moved_ns = volts, now_ns
