"""A board's evidence about its outputs: lowest and highest voltage, largest step, largest change within a millisecond.

The controller dates each write in the card's memory. The board limits this date to the time between two of its own
looks: after the last look without the write and before the first look with it. Dates never run backwards. A board that
looks often therefore does not depend on the controller's dates. A board that stood still neither invents a change,
because the writes keep their dates, nor hides one.

An output holds voltage v_i from t_i to t_(i+1). The change within a window is the largest |v_j − v_i|, i < j, with
t_j − t_(i+1) <= WINDOW_NS: two voltages that the output had at two instants no further apart than the window.
"""

from __future__ import annotations

import numpy as np

from rtloop.foundation.native.compiled import jit

WINDOW_NS = 1_000_000
MAX_LEVELS = 1024
"""Number of stored voltages of an output. A write that comes when the window has more voltages is compared with the
stored ones alone, and counted in `MISSED_WRITES`."""
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
"""A voltage of an output and the time in ns at which it began; before the first write, 0 V since time 0."""


@jit
def judge_write(evidence, levels, volts, written_ns, follows):
    """Add one write to the evidence of an output; return 1 if it cannot be compared with its whole window, else 0.

    `levels` (MAX_LEVELS,) stores the output's voltages, number i at index i modulo MAX_LEVELS. A write of the same
    voltage changes nothing. Without `follows`, the write is judged all the same, but the output is stuck and keeps its
    voltage.
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
    """Raise the evidence's largest step and largest change within WINDOW_NS by a write of `volts` at `written_ns`.

    `levels` has the last MAX_LEVELS voltages, as in `judge_write`. Returns 1 if they do not reach back to the beginning
    of the window, else 0.
    """
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
    """Record that the output itself has been at `volts` since `now_ns`; without a change, keep the earlier time."""
    if volts != evidence.last_v:
        evidence.last_v, evidence.moved_ns = volts, now_ns
