"""Play operators of an actuator that was driven before anybody looked: their memory at the first sample is not known.

Let the drive have covered C = [min u, max u] so far. At the two ends of C a play was clipped to F_r ≥ max u − r and to
F_r ≤ min u + r. Therefore

    2 r ≤ |C|:   F_r no longer depends on what it was at first: it is known
    2 r ≥ |C|:   max u − r ≤ F_r ≤ min u + r, which no drive within C leaves: F_r stands still until C grows

While the drive stays within what it has covered, a sum of plays is thus the known ones and a constant, exactly. While
it goes beyond, plays move of which nothing is known but the order of their thresholds: Σ p_i F_i then tells next to
nothing of the weights (Brokate & Sprekels, Hysteresis and Phase Transitions, 1996, section 2.3: memory curves).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.hil.modal import Real
from rtloop.hysteresis.plays import play_outputs

MIN_INTERVAL_SHARE = 0.03
"""Part of the drive's range that a stretch within what was covered has at least: noise makes small ones."""


class MissingStroke(NamedTuple):
    """What a drive left out, in V: from `turn_v`, the later of its two extremes, it came back to `reached_v` at the
    farthest and not to `goal_v`, the other extreme."""

    turn_v: float
    reached_v: float
    goal_v: float


def covered_intervals(drive: Real) -> npt.NDArray[np.intp]:
    """Number of the stretch within what was covered before that each sample (samples,) is in; −1 where in none.

    A stretch begins at an end of what was covered, and shows plays of up to half of its own range, no larger ones.
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
    """What would have let a stretch within what was covered have the drive's whole range."""
    low, high = int(np.argmin(drive)), int(np.argmax(drive))
    if low > high:
        return MissingStroke(float(drive[low]), float(drive[low:].max()), float(drive[high]))
    return MissingStroke(float(drive[high]), float(drive[high:].min()), float(drive[low]))


def first_determined_sample(drive: Real, threshold_v: float) -> int | None:
    """The first sample at which plays up to this threshold are known; None where that is never."""
    covered = np.maximum.accumulate(drive) - np.minimum.accumulate(drive)
    return int(np.argmax(covered >= 2 * threshold_v)) if covered[-1] >= 2 * threshold_v else None


def periodic_memory(drive: Real, thresholds: Real) -> Real:
    """What the plays (plays,) remember at the first sample if the same drive has gone before, again and again."""
    memory = np.full(thresholds.size, 0.5 * float(drive.max() + drive.min()))
    cycle = np.append(drive, drive[0])
    for _ in range(2):
        memory = play_outputs(cycle, thresholds, np.clip(memory, cycle[0] - thresholds, cycle[0] + thresholds))[-1]
    return memory
