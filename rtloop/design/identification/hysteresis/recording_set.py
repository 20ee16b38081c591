"""Recordings that share a model of hysteresis, and the model fitted to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.design.identification.axis_recording import AxisRecording, UnsuitableData, noise_std
from rtloop.design.identification.hysteresis.averaged_recording import (
    BLOCKS,
    AveragedRecording,
    Clock,
    Term,
    average_recording,
    build_equations,
)
from rtloop.design.identification.hysteresis.least_squares import Equations, Limits
from rtloop.foundation.arrays import Real
from rtloop.hysteresis.loop_shape import LoopShape, loop_shape
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import model_output

Weights = Literal["invertible", "free"]

LEAST_SLOPE = 0.05
"""Least partial sum of "invertible" weights, as a fraction of the mean slope, so that the inverse stays moderate."""
LARGEST_RMS_SHARE = 0.15
"""Largest rms error of an accepted fit, as a fraction of the range; even a straight line through a wide loop errs by
less.
"""


@dataclass(frozen=True)
class HysteresisFit:
    """Fitted model in V and µm, and its errors.

    `offsets_um` are the sensor offsets of the recordings; errors and noise refer to averaged samples. `range_um` is the
    largest range of position, `drive_v` the largest |drive|; both loops are of the recording with the widest drive.
    `least_slope_um_per_v` is the least partial sum that "invertible" weights may have, also where they are "free".
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


class Trial(NamedTuple):
    """Thresholds in V with the method of their placement, terms (drift, creep), and the variable that drives creep."""

    thresholds_v: Real
    placement: str
    terms: tuple[Term, ...]
    clock: Clock = "time"


class RecordingSet(NamedTuple):
    """Recordings that share a model, as `recorded` and averaged (`runs`), with the largest ranges of drive in V
    (`largest_v`) and position, the least slope in µm/V, and the longest duration and path of the drive.
    """

    recorded: Sequence[AxisRecording]
    runs: Sequence[AveragedRecording]
    weights: Weights
    largest_v: float
    range_um: float
    least_slope: float
    duration_s: float
    path_v: float

    @property
    def limits(self) -> Limits:
        """Limits of the slopes in a fit; the least slope is −inf for "free" weights."""
        return Limits(self.least_slope if self.weights == "invertible" else -np.inf, self.largest_v)

    def equations(self, run: AveragedRecording, trial: Trial) -> Equations:
        """Return the least-squares equations of one recording for a trial's thresholds and terms, a row per block."""
        return build_equations(run, trial.thresholds_v, trial.terms, trial.clock, self.duration_s, self.path_v)

    def describe_fit(self, trial: Trial, slopes: Real, offsets_um: Sequence[float], residual_um: Real) -> HysteresisFit:
        """Return the fit of a trial with the partial sums of its weights, `slopes` (plays,) in µm/V, the recordings'
        offsets, and the residuals of all their fitted blocks in µm.
        """
        model = PlayModel(trial.thresholds_v, np.diff(slopes, prepend=0.0))
        widest = max(self.recorded, key=lambda run: float(np.ptp(run.drive_v)))
        noises = [
            noise_std(run.position_um) ** 2 / part.size for run, part in zip(self.recorded, self.runs, strict=True)
        ]
        return HysteresisFit(
            model,
            tuple(offsets_um),
            float(np.sqrt(np.mean(residual_um**2))),
            float(np.abs(residual_um).max()),
            float(np.sqrt(np.mean(noises))),
            self.range_um,
            max(float(np.abs(run.drive_v).max()) for run in self.recorded),
            loop_shape(widest.drive_v[:-1], widest.position_um[1:]),
            loop_shape(widest.drive_v, model_output(model, widest.drive_v)),
            trial.placement,
            self.weights,
            self.least_slope,
        )

    def require_explanation(self, fit: HysteresisFit) -> HysteresisFit:
        """Return `fit` itself. Raises UnsuitableData if its rms error exceeds LARGEST_RMS_SHARE of `range_um`."""
        error_share = fit.rms_error_um / fit.range_um
        if error_share > LARGEST_RMS_SHARE:
            raise UnsuitableData(
                f"{', '.join(run.name for run in self.recorded)}: no sum of play operators predicts the position from "
                f"the drive: the best sum has an rms error of {100 * error_share:.0f} % of the position's range; "
                f"allowed: up to {100 * LARGEST_RMS_SHARE:.0f} %. Plot position over drive, and check that both "
                "signals belong to this axis, that the drive is slow, and that the sensor's sign is right"
            )
        return fit


def prepare_recordings(
    runs: Sequence[AxisRecording],
    weights: Weights,
    before_v: Sequence[npt.ArrayLike | None] | None,
    blocks: int = BLOCKS,
) -> RecordingSet:
    """Return the n recordings `runs`, each averaged over blocks, at most `blocks` // max(3, n) of them, or LEAST_BLOCKS
    if this number is smaller (`average_recording`). The length of a block differs between recordings.

    `before_v` has for each recording the drive in V from rest to its first tick, [0] for a start at rest, None if
    unknown; None instead of a list: unknown for all.
    """
    drives_before = [None] * len(runs) if before_v is None else before_v
    averaged_runs = [
        average_recording(run, len(runs), drive_before, blocks)
        for run, drive_before in zip(runs, drives_before, strict=True)
    ]
    largest_v = max(float(np.ptp(run.full_v)) for run in averaged_runs)
    range_um = max(float(np.ptp(run.position_um)) for run in averaged_runs)
    least_slope = LEAST_SLOPE * range_um / largest_v
    duration_s, path_v = np.max([(run.time_s[-1], run.path_v[-1]) for run in averaged_runs], axis=0).tolist()
    return RecordingSet(runs, averaged_runs, weights, largest_v, range_um, least_slope, duration_s, path_v)
