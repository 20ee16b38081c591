"""Recordings as the equations of a sum of plays with unknown memory need them: averaged, with bounds of every play."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.design.identification.hysteresis.memory_fit import Stretch
from rtloop.design.identification.measured import Measured
from rtloop.hil.modal import Real
from rtloop.hysteresis.plays import play_outputs

Term = Literal["drift", "creep"]
Clock = Literal["time", "path"]
"""What creep goes by. By the drive's path it is a memory that fades, which no passing of time makes."""

BLOCKS, LEAST_BLOCKS = 3000, 300
"""Averaged samples of all recordings together, and of each at least."""
CREEP_PARTS = (30.0, 6.0, 1.0)
"""Creep has time constants of the longest recording's duration over these."""
AT_ONCE = 100_000
"""Ticks whose plays are in memory at a time."""


class Kept(NamedTuple):
    """One recording, averaged over blocks: time in s since its first tick, drive in V, position in µm, the path that
    the drive has gone in V, each (blocks,).

    `full_v` is the drive of every tick, `size` the ticks of a block, `before_v` the drive since rest, None where
    unknown.
    """

    name: str
    time_s: Real
    drive_v: Real
    position_um: Real
    path_v: Real
    full_v: Real
    size: int
    before_v: Real | None


def kept(run: Measured, runs: int, before_v: npt.ArrayLike | None = None) -> Kept:
    """One of so many recordings; a drive is beside the position of the tick that follows it."""
    most = max(LEAST_BLOCKS, BLOCKS // max(3, runs))
    drive, size = run.drive_v[:-1], -(-(run.drive_v.size - 1) // most)
    time_s = run.seconds[:-1] - run.seconds[0]
    before = None if before_v is None else np.asarray(before_v, float)
    path_v = np.cumsum(np.abs(np.diff(drive, prepend=drive[0])))
    time_s, slow, position, path_v = averaged(np.column_stack([time_s, drive, run.position_um[1:], path_v]), size).T
    return Kept(run.name, time_s, slow, position, path_v, drive, size, before)


def stretch(
    run: Kept, thresholds: Real, terms: Sequence[Term], clock: Clock, duration_s: float, path_v: float
) -> Stretch:
    """With plays at these thresholds in V and these terms; `duration_s` and `path_v` are those of the longest
    recordings."""
    first_v = float(run.full_v[0])
    if run.before_v is None:
        low, high = (_plays(run, thresholds, first_v + side * thresholds) for side in (-1.0, 1.0))
    else:
        low = high = _plays(run, thresholds, play_outputs(np.append(run.before_v, first_v), thresholds)[-1])
    constant, since = np.ones(run.time_s.size), run.time_s / max(float(run.time_s[-1]), 1e-12) - 0.5
    own = np.column_stack([constant, since] if "drift" in terms else [constant])
    passed = run.time_s / duration_s if clock == "time" else run.path_v / path_v
    creep = [_lag(run.drive_v, passed, 1 / part) for part in CREEP_PARTS] if "creep" in terms else []
    return Stretch(first_v, low, high, np.array(creep).reshape(-1, run.time_s.size).T, own, run.position_um)


def averaged(rows: Real, size: int) -> Real:
    """Means of `size` successive rows; an incomplete block at the end is left out."""
    whole = rows[: rows.shape[0] // size * size]
    return whole.reshape(-1, size, rows.shape[1]).mean(axis=1)


def _plays(run: Kept, thresholds: Real, state: Real) -> Real:
    parts, at_once = [], max(1, AT_ONCE // run.size) * run.size
    for start in range(0, run.full_v.size, at_once):
        outputs = play_outputs(run.full_v[start : start + at_once], thresholds, state)
        state = outputs[-1]
        parts.append(averaged(outputs, run.size))
    return np.concatenate(parts)


def _lag(drive_v: Real, passed: Real, constant: float) -> Real:
    """Drive behind a first-order lag, which stood still at first: (blocks,). `passed` is what the constant is in."""
    shares = -np.expm1(-np.diff(passed, prepend=passed[0]) / constant)
    found, last = np.empty(drive_v.size), float(drive_v[0])
    for k, share in enumerate(shares):
        last += share * (drive_v[k] - last)
        found[k] = last
    return found
