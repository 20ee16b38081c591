"""Thresholds and weights of a Prandtl-Ishlinskii model from recorded slow drives (quasi-static: eq (4) of the paper).

    x_k+1 = Σ p_i F_{r_i}[u]_k + offset = Σ s_i (F_{r_i} − F_{r_{i+1}})[u]_k + offset,     s_i = Σ_{j≤i} p_j

For given thresholds this is linear in the weights (Kuhnen 2003). Written with their partial sums s_i, which are the
slopes of the initial loading curve, the condition that an inverse exists, s_i > 0, is a bound on each unknown: least
squares with bounds (`least_squares`) instead of a quadratic programme. From rest the memory is known throughout, and no
penalty on the slopes is needed.

Position and plays are averaged over blocks of equal length, both sides of a linear equation alike, so that a long
recording loses no accuracy. The lag of the plant adds rate × lag, which counts as hysteresis: drive slowly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from rtloop.design.identification.axis_recording import AxisRecording, UnsuitableData, require_rising
from rtloop.design.identification.hysteresis.initial_rest import require_loop
from rtloop.design.identification.hysteresis.least_squares import fit_gains, model_errors
from rtloop.design.identification.hysteresis.recording_set import (
    HysteresisFit,
    RecordingSet,
    Trial,
    Weights,
    prepare_recordings,
)
from rtloop.design.identification.hysteresis.thresholds import (
    Placement,
    candidate_placements,
    place_thresholds,
    require_ascending,
)

BLOCKS = 60_000
"""Averaged samples of all recordings together."""
FINEST_PLAYS, STRUCTURE_SHARE = 60, 2.5e-4
"""An actuator is no sum of plays if FINEST_PLAYS plays leave more than this fraction of the range besides noise."""
LEAST_DIRECTION = 1e-9
"""Smallest singular value of the scaled columns, relative to the largest, for weights that can be told apart."""


def identify_hysteresis(
    runs: Sequence[AxisRecording],
    count: int = 15,
    placement: Placement = "auto",
    thresholds_v: Sequence[float] | None = None,
    weights: Weights = "invertible",
) -> HysteresisFit:
    """Fit one model to all `runs`, each from rest at 0 V, with plays at `thresholds_v` in V; None: `count` plays placed
    by `placement`.

    "auto": with a dead band ("chebyshev") or without ("chebyshev-from-0"), whichever has the smaller rms error.
    "invertible" `weights` have an inverse: no partial sum is below LEAST_SLOPE of the mean slope. "free" ones may have
    none. Raises UnsuitableData for a run without rest or loop (`require_loop`), a wrong sign, thresholds that the drive
    does not exceed, weights that the drives do not determine, and an rms error above LARGEST_RMS_SHARE of the range;
    ValueError for a wrong `count`, `placement` or `thresholds_v`.
    """
    placements = candidate_placements(placement)
    for run in runs:
        require_loop(run)
        require_rising(run)
    recordings = prepare_recordings(runs, weights, [np.zeros(1)] * len(runs), BLOCKS)
    largest_v = max(float(np.abs(run.drive_v).max()) for run in runs)
    trials = [Trial(place_thresholds(count, largest_v, rule), rule, ()) for rule in placements]
    if thresholds_v is not None:
        trials = [Trial(np.array(thresholds_v, float), "given", ())]
        require_ascending(trials[0].thresholds_v)
        _require_thresholds_reached(trials[0], largest_v)
    best_fit = min((_fit_trial(recordings, trial) for trial in trials), key=lambda fit: fit.rms_error_um)
    return recordings.require_explanation(best_fit)


def unexplained_um(runs: Sequence[AxisRecording], fit: HysteresisFit) -> float:
    """Return the rms error in µm, beyond noise, that remains with `fit` and with FINEST_PLAYS plays, the smaller of
    both; 0 if it is at most STRUCTURE_SHARE of the range.
    """
    errors = fit.rms_error_um
    with suppress(UnsuitableData):  # the drives do not determine so many weights
        errors = min(errors, identify_hysteresis(runs, FINEST_PLAYS).rms_error_um)
    unexplained = math.sqrt(max(0.0, errors**2 - fit.noise_um**2))
    return unexplained if unexplained > STRUCTURE_SHARE * fit.range_um else 0.0


def _fit_trial(recordings: RecordingSet, trial: Trial) -> HysteresisFit:
    """Return the least-squares fit of weights at a trial's thresholds to all recordings. Raises UnsuitableData if the
    drives do not determine all weights.
    """
    equations = [recordings.equations(run, trial) for run in recordings.runs]
    columns = np.vstack([part.slopes for part in equations])
    singular_values = np.linalg.svd(columns / np.linalg.norm(columns, axis=0), compute_uv=False)
    if singular_values[-1] < LEAST_DIRECTION * singular_values[0]:
        raise UnsuitableData(
            f"too little excitation: these drives do not determine {trial.thresholds_v.size} weights, one for "
            "each play operator. Use fewer operators, or drives that turn back at several voltages"
        )
    common, own_gains = fit_gains(equations, recordings.limits._replace(drive_v=0.0))
    residuals_um = [model_errors(part, common, gains) for part, gains in zip(equations, own_gains, strict=True)]
    offsets_um = [float(gains[0]) for gains in own_gains]
    return recordings.describe_fit(trial, common.slopes, offsets_um, np.concatenate(residuals_um))


def _require_thresholds_reached(trial: Trial, largest_v: float) -> None:
    """Raise UnsuitableData for thresholds of the trial at or beyond `largest_v`, the largest |drive|."""
    unreached = trial.thresholds_v[trial.thresholds_v >= largest_v]
    if unreached.size:
        raise UnsuitableData(
            f"too little excitation: thresholds from {unreached[0]:g} V on are never reached by a drive of at most "
            f"{largest_v:g} V. Use a larger drive, or leave these thresholds out"
        )
