"""Recordings averaged for the equations of a sum of plays, with the stretches of known memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.design.identification.axis_recording import AxisRecording
from rtloop.design.identification.hysteresis.cross_validation import PIECES
from rtloop.design.identification.hysteresis.least_squares import Equations
from rtloop.foundation.arrays import Real
from rtloop.hysteresis.plays import play_outputs
from rtloop.hysteresis.unknown_memory import covered_intervals, periodic_memory

Term = Literal["drift", "creep"]
Clock = Literal["time", "path"]
"""Variable that drives creep. Over the drive's path, creep is a fading memory that time alone does not change."""

BLOCKS, LEAST_BLOCKS = 3000, 300
"""Averaged samples of all recordings together, and least number for each."""
CREEP_PARTS = (30.0, 6.0, 1.0)
"""Time constants of creep: the longest recording's duration divided by these."""
CHUNK_TICKS = 100_000
"""Ticks whose plays are in memory at a time."""


class AveragedRecording(NamedTuple):
    """Recording averaged over blocks: time in s since its first tick, drive in V, position in µm, path of the drive
    (the sum of its changes) in V, each (blocks,).

    A stretch is a part of the recording in which the state of all plays that move is known. `stretch` (blocks,) numbers
    them from 0, −1 for a block outside them; plays of up to half of `stroke_v` move within them. `full_v` is the drive
    of every tick, `size` the ticks of a block. `before_v` (k,) is the drive in V from rest to the first tick, None
    where unknown.
    """

    name: str
    time_s: Real
    drive_v: Real
    position_um: Real
    path_v: Real
    stretch: npt.NDArray[np.intp]
    stroke_v: float
    full_v: Real
    size: int
    before_v: Real | None


def average_recording(
    run: AxisRecording, runs: int, before_v: npt.ArrayLike | None = None, blocks: int = BLOCKS
) -> AveragedRecording:
    """Return the recording `run` averaged over blocks: at most `blocks` // max(3, `runs`) of them, but LEAST_BLOCKS if
    this number is smaller. `runs` is the number of recordings of the fit.

    Each drive is paired with the position of the following tick. `before_v` (k,) is the drive in V from rest to the
    first tick, [0] for a start at rest, None if unknown. Unless it is None, the whole recording is one stretch.
    """
    most_blocks = max(LEAST_BLOCKS, blocks // max(3, runs))
    drive, size = run.drive_v[:-1], -(-(run.drive_v.size - 1) // most_blocks)
    time_s = run.seconds[:-1] - run.seconds[0]
    drive_before = None if before_v is None else np.asarray(before_v, float)
    path_v = np.cumsum(np.abs(np.diff(drive, prepend=drive[0])))
    time_s, mean_drive, position, path_v = block_means(
        np.column_stack([time_s, drive, run.position_um[1:], path_v]), size
    ).T
    if drive_before is None:
        stretch, stroke_v = _number_stretches(drive, size)
    else:
        stretch, stroke_v = np.zeros(mean_drive.size, np.intp), 2 * float(np.abs(np.append(drive_before, drive)).max())
    return AveragedRecording(
        run.name, time_s, mean_drive, position, path_v, stretch, stroke_v, drive, size, drive_before
    )


def build_equations(
    run: AveragedRecording, thresholds: Real, terms: Sequence[Term], clock: Clock, duration_s: float, path_v: float
) -> Equations:
    """Build the equations for plays at `thresholds` (V) and `terms`, with a row for each of the run's blocks.

    `terms` may contain "drift" and "creep", a lag of the drive over time or, if `clock` is "path", over the path: the
    sum of the drive's changes. `duration_s` and `path_v` are the longest duration and path of all runs. The memory
    before the first tick, if unknown, is assumed to come from earlier repetitions of the same drive.
    """
    if run.before_v is None:
        memory = periodic_memory(run.full_v, thresholds)
    else:
        memory = play_outputs(np.append(run.before_v, run.full_v[0]), thresholds)[-1]
    plays = play_block_means(run, thresholds, memory)
    plays[:, :-1] -= plays[:, 1:].copy()
    stretches = int(run.stretch.max()) + 1
    offsets = np.where(run.stretch < 0, stretches - 1, run.stretch)[:, None] == np.arange(stretches)
    centred_time = run.time_s / max(float(run.time_s[-1]), 1e-12) - 0.5
    drift = [centred_time] if "drift" in terms else []
    elapsed = run.time_s / duration_s if clock == "time" else run.path_v / path_v
    creep = [lagged_drive(run.drive_v, elapsed, 1 / part) for part in CREEP_PARTS] if "creep" in terms else []
    return Equations(
        plays,
        np.array(creep).reshape(-1, centred_time.size).T,
        offsets.astype(float),
        np.array(drift).reshape(-1, centred_time.size).T,
        run.position_um,
        run.stretch >= 0,
    )


def _number_stretches(drive: Real, size: int) -> tuple[npt.NDArray[np.intp], float]:
    """Return the number of the stretch of every block of `size` ticks, (blocks,), and the largest range of the drive
    within a numbered stretch in V, 0 if there is none.

    Stretches, in which the state of all plays that move is known, are numbered from 0; −1 marks blocks that are not
    wholly in one stretch, and all blocks of a stretch with fewer than PIECES. An incomplete last block is omitted.
    """
    numbers = covered_intervals(drive)
    tick_numbers = numbers[: drive.size // size * size].reshape(-1, size)
    block_numbers = np.where(np.all(tick_numbers == tick_numbers[:, :1], axis=1), tick_numbers[:, 0], -1)
    stretch, stroke_v = np.full(block_numbers.size, -1), 0.0
    for number in np.flatnonzero(np.bincount(block_numbers[block_numbers >= 0]) >= PIECES):
        stretch[block_numbers == number] = stretch.max() + 1
        stroke_v = max(stroke_v, float(np.ptp(drive[numbers == number])))
    return stretch, stroke_v


def play_block_means(run: AveragedRecording, thresholds: Real, state: Real) -> Real:
    """Return the means of the plays' outputs in V over each complete block, (blocks, plays); `state` (plays,) has their
    outputs before the first tick.
    """
    parts, chunk_ticks = [], max(1, CHUNK_TICKS // run.size) * run.size
    for start in range(0, run.full_v.size, chunk_ticks):
        outputs = play_outputs(run.full_v[start : start + chunk_ticks], thresholds, state)
        state = outputs[-1]
        parts.append(block_means(outputs, run.size))
    return np.concatenate(parts)


def block_means(rows: Real, size: int) -> Real:
    """Return the means of `size` successive rows, (blocks, columns); an incomplete block at the end is omitted."""
    complete = rows[: rows.shape[0] // size * size]
    return complete.reshape(-1, size, rows.shape[1]).mean(axis=1)


def lagged_drive(drive_v: Real, elapsed: Real, time_constant: float) -> Real:
    """Return the drive in V behind a first-order lag, (blocks,); the lag starts at rest, at the first drive.

    `elapsed` (blocks,) is the time or the path of each block; `time_constant` has its unit.
    """
    shares = -np.expm1(-np.diff(elapsed, prepend=elapsed[0]) / time_constant)
    lagged, level = np.empty(drive_v.size), float(drive_v[0])
    for k, share in enumerate(shares):
        level += share * (drive_v[k] - level)
        lagged[k] = level
    return lagged
