"""Test whether the residual of a sum of plays is a lag over time, such as creep."""

from __future__ import annotations

import numpy as np

from rtloop.design.identification.axis_recording import AxisRecording, noise_std
from rtloop.design.identification.hysteresis.averaged_recording import (
    CREEP_PARTS,
    average_recording,
    block_means,
    lagged_drive,
)
from rtloop.design.identification.hysteresis.identify_hysteresis import FINEST_PLAYS
from rtloop.design.identification.hysteresis.thresholds import place_thresholds
from rtloop.foundation.arrays import Real
from rtloop.hysteresis.plays import play_outputs

EXPLAINED_SHARE = 0.5
"""Fraction of the residual that may remain with lags, for creep to be likely."""


def is_creep_likely(run: AxisRecording) -> bool:
    """Whether plays with lags of the drive leave less than EXPLAINED_SHARE of the residual of plays alone, noise aside.

    A recording from rest at one speed is no proof: a memory that fades with the drive's path looks the same.
    """
    blocks = average_recording(run, 1, [0.0])
    thresholds = place_thresholds(FINEST_PLAYS, float(np.abs(run.drive_v).max()), "chebyshev-from-0")
    plays = play_outputs(run.drive_v[:-1], thresholds)
    columns = np.column_stack([block_means(plays, blocks.size), np.ones(blocks.time_s.size)])
    elapsed = blocks.time_s / blocks.time_s[-1]
    lags = np.column_stack([lagged_drive(blocks.drive_v, elapsed, 1 / part) for part in CREEP_PARTS])
    noise = noise_std(run.position_um) ** 2 / blocks.size
    plays_only, with_lags = (
        max(_residual_mean_square(matrix, blocks.position_um) - noise, 0.0)
        for matrix in (columns, np.hstack([columns, lags]))
    )
    return with_lags < EXPLAINED_SHARE**2 * plays_only


def _residual_mean_square(columns: Real, position_um: Real) -> float:
    """Return the mean square of the residual of `position_um` after least squares on `columns`."""
    solution = np.linalg.lstsq(columns, position_um)[0]
    return float(np.mean((position_um - columns @ solution) ** 2))
