"""Play operators with unknown initial memory: the actuator moved before the recording began.

Let the drive have covered C = [min u, max u] so far. At the two ends of C a play was clipped to F_r ≥ max u − r and to
F_r ≤ min u + r. Therefore

    2 r ≤ |C|:   F_r no longer depends on its initial output: it is determined
    2 r ≥ |C|:   max u − r ≤ F_r ≤ min u + r, which no drive within C leaves: F_r is constant until C grows

While the drive stays within C, a sum of plays is thus exactly the determined plays plus a constant. While C grows,
undetermined plays move, of which only the order of the thresholds is known: Σ p_i F_i then says very little about the
weights (Brokate & Sprekels, Hysteresis and Phase Transitions, 1996, section 2.3: memory curves)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.hysteresis.plays import play_outputs

MIN_INTERVAL_SHARE = 0.03
"""Least range of a covered interval, as a fraction of the drive's range; noise produces smaller ones."""


class MissingStroke(NamedTuple):
    """Stroke missing from a drive, in V: from `turn_v`, the later of its two extremes, the drive returned only to
    `reached_v` and not to `goal_v`, the other extreme."""

    turn_v: float
    reached_v: float
    goal_v: float


def covered_intervals(drive: Real) -> npt.NDArray[np.intp]:
    """Return for each sample (samples,) the number of its covered interval, from 0, and −1 outside all intervals.

    A covered interval is a run of samples within the range that the drive covered before. It follows a sample at an
    end of that range. Plays with thresholds up to half the interval's range are observable in it. Runs with a range
    below MIN_INTERVAL_SHARE of the drive's are omitted.
    """
    is_extended = np.diff(np.maximum.accumulate(drive)) - np.diff(np.minimum.accumulate(drive)) > 0
    beyond = np.concatenate([[True], is_extended, [True]])
    numbers, number, minimum_v = np.full(drive.size, -1), 0, MIN_INTERVAL_SHARE * float(np.ptp(drive))
    for start, end in np.flatnonzero(np.diff(beyond)).reshape(-1, 2):
        if np.ptp(drive[start : end + 1]) >= minimum_v:
            numbers[start + 1 : end + 1] = number
            number += 1
    return numbers


def missing_stroke(drive: Real) -> MissingStroke:
    """Return the stroke after which a covered interval over the drive's whole range would have been recorded.

    There is always one: the caller asks only about a drive without such an interval.
    """
    low, high = int(np.argmin(drive)), int(np.argmax(drive))
    if low > high:
        return MissingStroke(float(drive[low]), float(drive[low:].max()), float(drive[high]))
    return MissingStroke(float(drive[high]), float(drive[high:].min()), float(drive[low]))


def first_determined_sample(drive: Real, threshold_v: float) -> int | None:
    """Return the index of the first sample by which the drive covered 2 · `threshold_v`, so that plays up to this
    threshold are determined; None if there is none.
    """
    covered = np.maximum.accumulate(drive) - np.minimum.accumulate(drive)
    return int(np.argmax(covered >= 2 * threshold_v)) if covered[-1] >= 2 * threshold_v else None


def periodic_memory(drive: Real, thresholds: Real) -> Real:
    """Return the plays' outputs (plays,) at the first sample, if the same drive (samples,) was repeated before as a
    periodic cycle: two cycles are simulated from the middle of the drive's range.
    """
    memory = np.full(thresholds.size, 0.5 * float(drive.max() + drive.min()))
    cycle = np.append(drive, drive[0])
    for _ in range(2):
        memory = play_outputs(cycle, thresholds, np.clip(memory, cycle[0] - thresholds, cycle[0] + thresholds))[-1]
    return memory
