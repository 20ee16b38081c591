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

from rtloop.foundation.native.compiled import jit

WINDOW_NS = 1_000_000
MAX_LEVELS = 1024
"""Voltages of an output that are remembered. More within one window are not judged but counted as unseen."""
EVIDENCE = np.dtype(
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
LEVEL = np.dtype([("volts", np.float64), ("from_ns", np.int64)])
"""A voltage that an output had, and since when; before the first write 0 V, for ever."""


@jit
def judge_write(evidence, levels, volts, written_ns, follows):
    """Judge one write to an output; returns 1 if so many writes fell into its window that it cannot be judged, else 0.

    `levels` (MAX_LEVELS,) holds the output's voltages, number i at i modulo MAX_LEVELS. Where `follows` is not set, the
    output is stuck, and the write does not move it.
    """
    if volts == evidence.written_v:
        return 0
    newest = evidence.levels
    written_ns = max(written_ns, levels[newest % MAX_LEVELS].from_ns)
    is_unjudged = _compare_with_window(evidence, levels, volts, written_ns)
    evidence.levels = newest + 1
    levels[evidence.levels % MAX_LEVELS].volts = volts
    levels[evidence.levels % MAX_LEVELS].from_ns = written_ns
    evidence.written_v = volts
    evidence.lowest_v = min(evidence.lowest_v, volts)
    evidence.highest_v = max(evidence.highest_v, volts)
    if follows:
        record_level(evidence, volts, written_ns)
    return is_unjudged


@jit
def _compare_with_window(evidence, levels, volts, written_ns):
    """Compare a new voltage with those that the output had within the window; returns 1 if not all are remembered."""
    evidence.largest_step_v = max(evidence.largest_step_v, abs(volts - evidence.written_v))
    i, first = evidence.levels, max(evidence.levels - MAX_LEVELS + 1, 0)
    while True:
        level = levels[i % MAX_LEVELS]
        evidence.largest_window_v = max(evidence.largest_window_v, abs(volts - level.volts))
        if i == 0 or written_ns - level.from_ns > WINDOW_NS:
            return 0
        if i == first:
            return 1
        i -= 1


@jit
def record_level(evidence, volts, now_ns):
    """Note that the output itself is at `volts` since `now_ns`."""
    if volts != evidence.last_v:
        evidence.last_v, evidence.moved_ns = volts, now_ns
