"""Thresholds and weights of a Prandtl-Ishlinskii model from recorded slow drives (quasi-static: eq (4) of the paper).

    x_k+1 = Σ p_i F_{r_i}[u]_k + offset = Σ s_i (F_{r_i} − F_{r_{i+1}})[u]_k + offset,     s_i = Σ_{j≤i} p_j

For given thresholds this is linear in the weights (Kuhnen 2003). Written with their partial sums s_i, which are the
slopes of the initial loading curve, the condition that an inverse exists, s_i > 0, is a bound on each unknown: least
squares with bounds instead of a quadratic programme.

Position and plays are averaged over blocks of equal length, both sides of a linear equation alike, so that a long
recording loses no accuracy. The lag of the plant adds rate × lag, which counts as hysteresis: drive slowly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from rtloop.design.identification.axis_recording import AxisRecording, UnsuitableData, noise_std, require_rising
from rtloop.design.identification.hysteresis.initial_rest import require_loop
from rtloop.design.identification.hysteresis.thresholds import (
    Placement,
    candidate_placements,
    place_thresholds,
    require_ascending,
)
from rtloop.foundation.arrays import Real
from rtloop.hysteresis.loop_shape import LoopShape, loop_shape
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import model_output, play_outputs

Weights = Literal["invertible", "free"]

BLOCKS = 20_000
"""Most averaged samples of each recording."""
LEAST_SLOPE = 0.05
"""Least partial sum of "invertible" weights, as a fraction of the mean slope, so that the inverse stays moderate."""
FINEST_PLAYS, STRUCTURE_SHARE = 60, 2.5e-4
"""An actuator is no sum of plays if FINEST_PLAYS plays leave more than this fraction of the range besides noise."""
LARGEST_RMS_SHARE = 0.15
"""Largest rms error of an accepted fit, as a fraction of the range; even a straight line through a wide loop errs by
less.
"""
LEAST_DIRECTION = 1e-9
"""Smallest singular value of the scaled columns, relative to the largest, for weights that can be told apart."""


@dataclass(frozen=True)
class HysteresisFit:
    """Fitted model in V and µm, and its errors.

    `offsets_um` holds the sensor offset of each recording; errors and noise refer to averaged samples; percentages to
    the range.
    """

    model: PlayModel
    offsets_um: tuple[float, ...]
    rms_error_um: float
    max_error_um: float
    noise_um: float
    range_um: float
    drive_v: float
    measured_loop: LoopShape
    model_loop: LoopShape
    placement: str
    weights: Weights
    least_slope_um_per_v: float

    @property
    def is_invertible(self) -> bool:
        """Whether every partial sum of the weights is above 0."""
        return bool(np.all(np.cumsum(self.model.weights) > 0))


class _Equations(NamedTuple):
    columns: Real
    position_um: Real


def identify_hysteresis(
    runs: Sequence[AxisRecording],
    count: int = 15,
    placement: Placement = "auto",
    thresholds_v: Sequence[float] | None = None,
    weights: Weights = "invertible",
) -> HysteresisFit:
    """The model that fits all `runs`, each from rest at 0 V. Raises UnsuitableData, ValueError for the options.

    "auto": with a dead band ("chebyshev") or without ("chebyshev-from-0"), whichever leaves less of the recordings.
    """
    placements = candidate_placements(placement)
    for run in runs:
        require_loop(run)
        require_rising(run)
    largest_v = max(float(np.abs(run.drive_v).max()) for run in runs)
    if thresholds_v is not None:
        return require_explanation(
            _fit_at_thresholds(runs, np.array(thresholds_v, float), "given", weights, largest_v), runs
        )
    fits = [
        _fit_at_thresholds(runs, place_thresholds(count, largest_v, rule), rule, weights, largest_v)
        for rule in placements
    ]
    return require_explanation(min(fits, key=lambda fit: fit.rms_error_um), runs)


def require_explanation(fit: HysteresisFit, runs: Sequence[AxisRecording]) -> HysteresisFit:
    """Return `fit`. Raises UnsuitableData if its rms error exceeds LARGEST_RMS_SHARE of the range."""
    error_share = fit.rms_error_um / fit.range_um
    if error_share > LARGEST_RMS_SHARE:
        raise UnsuitableData(
            f"{', '.join(run.name for run in runs)}: no sum of plays explains how the position follows the drive: the "
            f"best errs by {100 * error_share:.0f} % of the range (rms), and {100 * LARGEST_RMS_SHARE:.0f} % are "
            "allowed. Look at "
            "position over drive: are these the axis's own signals, of one slow drive, and is the sensor's sign right?"
        )
    return fit


def unexplained_um(runs: Sequence[AxisRecording], fit: HysteresisFit) -> float:
    """Return the rms in µm that no sum of plays explains, without noise; 0 if at most STRUCTURE_SHARE of the range."""
    errors = fit.rms_error_um
    with suppress(UnsuitableData):  # so many cannot be told apart
        errors = min(errors, identify_hysteresis(runs, FINEST_PLAYS).rms_error_um)
    unexplained = math.sqrt(max(0.0, errors**2 - fit.noise_um**2))
    return unexplained if unexplained > STRUCTURE_SHARE * fit.range_um else 0.0


def _fit_at_thresholds(
    runs: Sequence[AxisRecording], thresholds: Real, placement: str, weights: Weights, largest_v: float
) -> HysteresisFit:
    """Fit plays at `thresholds` (V)."""
    require_ascending(thresholds)
    _require_thresholds_reached(thresholds, largest_v)
    equations = [_build_equations(run, thresholds, i, len(runs)) for i, run in enumerate(runs)]
    columns = np.vstack([part.columns for part in equations])
    position = np.concatenate([part.position_um for part in equations])
    range_um = max(float(np.ptp(part.position_um)) for part in equations)
    least_slope = LEAST_SLOPE * range_um / max(float(np.ptp(run.drive_v)) for run in runs)
    slopes, offsets = _solve_slopes(
        columns, position, thresholds.size, least_slope if weights == "invertible" else -np.inf
    )
    errors = columns @ np.concatenate([slopes, offsets]) - position
    model = PlayModel(thresholds, np.diff(slopes, prepend=0.0))
    widest = max(runs, key=lambda run: float(np.ptp(run.drive_v)))
    return HysteresisFit(
        model,
        tuple(offsets.tolist()),
        float(np.sqrt(np.mean(errors**2))),
        float(np.abs(errors).max()),
        float(np.sqrt(np.mean([noise_std(run.position_um) ** 2 / _block_size(run) for run in runs]))),
        range_um,
        largest_v,
        loop_shape(widest.drive_v[:-1], widest.position_um[1:]),
        loop_shape(widest.drive_v, model_output(model, widest.drive_v)),
        placement,
        weights,
        least_slope,
    )


def _build_equations(run: AxisRecording, thresholds: Real, index: int, runs: int) -> _Equations:
    """Averaged columns (blocks, plays + runs) and positions (blocks,); a column of ones for the run's own offset."""
    plays = play_outputs(run.drive_v[:-1], thresholds)
    plays[:, :-1] -= plays[:, 1:].copy()
    offset = np.zeros((plays.shape[0], runs))
    offset[:, index] = 1.0
    size = _block_size(run)
    return _Equations(
        _block_means(np.hstack([plays, offset]), size), _block_means(run.position_um[1:, None], size)[:, 0]
    )


def _block_size(run: AxisRecording) -> int:
    """Return the number of samples in a block."""
    return max(1, (run.drive_v.size - 1) // BLOCKS)


def _block_means(rows: Real, size: int) -> Real:
    """Means of `size` successive rows; an incomplete block at the end is left out."""
    complete = rows[: rows.shape[0] // size * size]
    return complete.reshape(-1, size, rows.shape[1]).mean(axis=1)


def _solve_slopes(columns: Real, position: Real, plays: int, least_slope: float) -> tuple[Real, Real]:
    """Slopes ≥ `least_slope` and offsets, by least squares. Raises UnsuitableData where they cannot be told apart."""
    scale = np.linalg.norm(columns, axis=0)
    singular_values = np.linalg.svd(columns / scale, compute_uv=False)
    if singular_values[-1] < LEAST_DIRECTION * singular_values[0]:
        raise UnsuitableData(
            f"too little excitation: {plays} weights cannot be told apart by these drives; fewer operators, or drives "
            "with loops of several sizes, would help"
        )
    triangle, remainder = np.linalg.qr(columns / scale), position
    bounds = np.concatenate([np.full(plays, least_slope) * scale[:plays], np.full(columns.shape[1] - plays, -np.inf)])
    solution = lsq_linear(triangle.R, triangle.Q.T @ remainder, (bounds, np.inf), method="bvls", tol=1e-12).x / scale
    return solution[:plays], solution[plays:]


def _require_thresholds_reached(thresholds: Real, largest_v: float) -> None:
    unreached = thresholds[thresholds >= largest_v]
    if unreached.size:
        raise UnsuitableData(
            f"too little excitation: thresholds from {unreached[0]:g} V on are never reached by a drive of at most "
            f"{largest_v:g} V; drive further, or leave them out"
        )
