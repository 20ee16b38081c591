"""Play operators of an actuator that was driven before anybody looked: their memory at the first sample is not known.

A play clips its last value to u ± r, and clips in succession are one clip. From a first value z, therefore,

    F_r[u]_k = min(max(z, low_k), high_k),     low, high: the plays that began at u_0 − r and at u_0 + r

The two bounds meet once the drive has covered 2 r, and the play is known from there on, whatever z was. Plays of one
actuator share a memory curve λ(r) = F_r with λ(0) = u_0 and |λ(r′) − λ(r)| ≤ |r′ − r| (Brokate & Sprekels, Hysteresis
and Phase Transitions, 1996, section 2.3): the first values of neighbours are apart by no more than their thresholds.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rtloop.hil.modal import Real
from rtloop.hysteresis.plays import play_outputs, turning_points

LEAST_TURN = 1e-3
"""Part of the drive's range by which it must turn back for a stroke to end."""


class Missing(NamedTuple):
    """What a drive left out, in V: from `turn_v`, the later of its two extremes, it came back to `reached_v` at the
    farthest and not to `goal_v`, the other extreme."""

    turn_v: float
    reached_v: float
    goal_v: float


def known_stroke_v(drive: Real) -> float:
    """The longest way in V that the drive went in one direction, from where it had covered as much before.

    Plays of up to half of it show beyond doubt, and no larger ones. 0 where the drive never turns back.
    """
    turns = [0, *turning_points(drive, LEAST_TURN * float(np.ptp(drive))).tolist(), drive.size - 1]
    return max(min(float(np.ptp(drive[: k + 1])), abs(float(drive[end] - drive[k]))) for k, end in pairwise(turns))


def missing_stroke(drive: Real) -> Missing:
    """What would have let `known_stroke_v` be the drive's whole range."""
    low, high = int(np.argmin(drive)), int(np.argmax(drive))
    if low > high:
        return Missing(float(drive[low]), float(drive[low:].max()), float(drive[high]))
    return Missing(float(drive[high]), float(drive[high:].min()), float(drive[low]))


def known_from(drive: Real, threshold_v: float) -> int | None:
    """The first sample at which plays up to this threshold are known; None where that is never."""
    covered = np.maximum.accumulate(drive) - np.minimum.accumulate(drive)
    return int(np.argmax(covered >= 2 * threshold_v)) if covered[-1] >= 2 * threshold_v else None


def settled_memory(drive: Real, thresholds: Real) -> Real:
    """What the plays (plays,) remember at the first sample if the same drive has gone before, again and again."""
    memory = np.full(thresholds.size, 0.5 * float(drive.max() + drive.min()))
    cycle = np.append(drive, drive[0])
    for _ in range(2):
        memory = play_outputs(cycle, thresholds, np.clip(memory, cycle[0] - thresholds, cycle[0] + thresholds))[-1]
    return memory
