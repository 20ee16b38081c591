"""Test whether the residual of a sum of plays is a lag over time, such as creep."""

from __future__ import annotations

import numpy as np

from rtloop.design.identification.axis_recording import AxisRecording, noise_std
from rtloop.design.identification.hysteresis.identify_hysteresis import FINEST_PLAYS
from rtloop.design.identification.hysteresis.recording_set import Trial, prepare_recordings
from rtloop.design.identification.hysteresis.thresholds import place_thresholds
from rtloop.foundation.arrays import Real

EXPLAINED_SHARE = 0.5
"""Creep is likely if less than this fraction of the rms residual remains with lags."""


def is_creep_likely(run: AxisRecording) -> bool:
    """Whether plays with lags of the drive leave less than EXPLAINED_SHARE of the rms residual of plays alone, each
    less noise. `run` must begin at rest.

    True is no proof of creep with a drive of one speed: a memory that fades with the drive's path looks the same.
    """
    recordings = prepare_recordings([run], "free", [np.zeros(1)])
    thresholds = place_thresholds(FINEST_PLAYS, float(np.abs(run.drive_v).max()), "chebyshev-from-0")
    equations = recordings.equations(recordings.runs[0], Trial(thresholds, "chebyshev-from-0", ("creep",)))
    columns = np.hstack([equations.slopes, equations.offsets])
    noise = noise_std(run.position_um) ** 2 / recordings.runs[0].size
    plays_only, with_lags = (
        max(_residual_mean_square(matrix, equations.position_um) - noise, 0.0)
        for matrix in (columns, np.hstack([columns, equations.creep]))
    )
    return with_lags < EXPLAINED_SHARE**2 * plays_only


def describe_unexplained(left_um: float, is_creep: bool) -> str:
    """Return what an error that plays leave, in µm rms, says of the actuator, without full stop."""
    error = f"with any number of play operators, an error of {left_um:.3g} µm rms remains"
    if is_creep:
        return (
            f"the position seems to creep: {error}, and a lag over time explains most of it. To measure creep, give "
            "`rtloop identify hysteresis` recordings at several speeds"
        )
    return (
        f"no sum of play operators describes the actuator: {error}. It may be larger for small steps and for "
        "hysteresis loops of other sizes"
    )


def _residual_mean_square(columns: Real, position_um: Real) -> float:
    """Return the mean square of the residual of `position_um` (n,) after least squares on `columns` (n, k)."""
    solution = np.linalg.lstsq(columns, position_um)[0]
    return float(np.mean((position_um - columns @ solution) ** 2))
