"""What recordings are under a sum of plays that they had no part in: errors as held out, offset, drift, memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.design.identification.hysteresis.early_part import early_errors
from rtloop.design.identification.hysteresis.held_out import held_out_errors, unseen_errors
from rtloop.design.identification.hysteresis.identify_hysteresis import LEAST_SLOPE, HysteresisFit, Weights
from rtloop.design.identification.hysteresis.least_squares import (
    Equations,
    Limits,
    SharedGains,
    fit_gains,
    fit_own_gains,
    model_errors,
)
from rtloop.design.identification.hysteresis.stretches import (
    AveragedRecording,
    Clock,
    Term,
    average_recording,
    build_equations,
)
from rtloop.design.identification.measured import AxisRecording
from rtloop.hil.modal import Real
from rtloop.hysteresis.unknown_memory import first_determined_sample

UNSETTLED_SHARE = 0.08
"""Part of its range by which a recording's beginning may depart from a loop that repeats itself: scanners whose
branches differ in shape, or creep, depart by half of it where their loops close."""


@dataclass(frozen=True)
class Judgement:
    """A recording under a model that it had no part in: averaged samples (blocks,), and what was found of its own.

    `error_um` is held out, NaN where the memory is not known, `written_error_um` the same of the plays that are
    written, without drift and creep, and `early_error_um` is that of the other blocks, with a memory estimated for
    these alone (`early_part`), NaN elsewhere; `residual_um` is what the model that is written leaves of the rest.
    `offset_um` is the last stretch's. `from_rest` says that the memory at the beginning was given; `known_from_s`
    is when that of all plays that are written is known, None where never; `unsettled_um` how far the recording
    departs from a loop that repeats itself where it is not; `drift_um` the drift over its duration.
    """

    name: str
    time_s: Real
    drive_v: Real
    position_um: Real
    error_um: Real
    written_error_um: Real
    early_error_um: Real
    residual_um: Real
    offset_um: float
    drift_um: float
    starts_from_rest: bool
    known_from_s: float | None
    unsettled_um: float

    @property
    def range_um(self) -> float:
        """What the position covers."""
        return float(np.ptp(self.position_um))

    @property
    def judged_share(self) -> float:
        """Part of the recording in which memory is known; nothing else is judged."""
        return float(np.mean(np.isfinite(self.error_um)))

    @property
    def rms_um(self) -> float:
        """Of the errors as held out; NaN without any."""
        return float(np.sqrt(np.nanmean(self.error_um**2))) if self.judged_share else np.nan

    @property
    def written_rms_um(self) -> float:
        """Of the plays that are written, as held out; NaN without any."""
        return float(np.sqrt(np.nanmean(self.written_error_um**2))) if self.judged_share else np.nan

    @property
    def max_um(self) -> float:
        """The largest error as held out; NaN without any."""
        return float(np.nanmax(np.abs(self.error_um))) if self.judged_share else np.nan

    @property
    def early_max_um(self) -> float:
        """The largest error where the memory is not known; NaN without any."""
        return float(np.nanmax(np.abs(self.early_error_um))) if np.isfinite(self.early_error_um).any() else np.nan

    @property
    def is_unsettled(self) -> bool:
        """Its beginning is no part of a loop that repeats itself."""
        return not self.starts_from_rest and self.unsettled_um > UNSETTLED_SHARE * self.range_um


class CombinedError(NamedTuple):
    """An error in µm rms over recordings of equal weight, and its standard error by their spread; None of a single one.

    Delta method: var(rms) = var(mean square)/(4 rms²). Recordings of few strokes spread so unevenly that it is too
    small.
    """

    rms_um: float
    std_um: float | None


def combine_errors(rms_um: Sequence[float]) -> CombinedError:
    """Of the errors of several recordings, NaN where one has none."""
    squares = np.square([value for value in rms_um if np.isfinite(value)])
    rms = float(np.sqrt(squares.mean())) if squares.size else np.nan
    if squares.size < 2:
        return CombinedError(rms, None)
    return CombinedError(rms, float(np.std(squares, ddof=1) / squares.size**0.5 / max(2 * rms, 1e-300)))


class Trial(NamedTuple):
    """Thresholds in V and terms; how the thresholds were placed, what creep goes by."""

    thresholds_v: Real
    placement: str
    terms: tuple[Term, ...]
    clock: Clock = "time"


class RecordingSet(NamedTuple):
    """Recordings that share a model, the largest ranges of drive and position among them, the least slope, the
    longest time and path of the drive."""

    runs: Sequence[AveragedRecording]
    largest_v: float
    range_um: float
    least_slope: float
    duration_s: float
    path_v: float

    @property
    def limits(self) -> Limits:
        """Of a fit."""
        return Limits(self.least_slope, self.largest_v)

    def equations(self, run: AveragedRecording, trial: Trial) -> Equations:
        """Of one recording."""
        return build_equations(run, trial.thresholds_v, trial.terms, trial.clock, self.duration_s, self.path_v)


def evaluate_from_rest(
    runs: Sequence[AxisRecording], shape: HysteresisFit, others: Sequence[AxisRecording] = ()
) -> tuple[tuple[Judgement, ...], tuple[Judgement, ...]]:
    """`runs`, each from rest and held out in turn, and `others`, of unknown memory, under plays placed as in
    `shape`."""
    recordings = prepare_recordings(runs, shape.weights, [np.zeros(1)] * len(runs))
    trial = Trial(shape.model.thresholds, shape.placement, ())
    return fit_and_judge(recordings, trial, others)[1:]


def prepare_recordings(
    runs: Sequence[AxisRecording], weights: Weights, before_v: Sequence[npt.ArrayLike | None] | None
) -> RecordingSet:
    """Recordings, averaged; `before_v` is the drive of each since rest, where that is known."""
    drives_before = [None] * len(runs) if before_v is None else before_v
    averaged_runs = [
        average_recording(run, len(runs), drive_before) for run, drive_before in zip(runs, drives_before, strict=True)
    ]
    largest_v = max(float(np.ptp(run.full_v)) for run in averaged_runs)
    range_um = max(float(np.ptp(run.position_um)) for run in averaged_runs)
    least_slope = LEAST_SLOPE * range_um / largest_v if weights == "invertible" else -np.inf
    duration_s, path_v = np.max([(run.time_s[-1], run.path_v[-1]) for run in averaged_runs], axis=0).tolist()
    return RecordingSet(averaged_runs, largest_v, range_um, least_slope, duration_s, path_v)


def fit_and_judge(
    work: RecordingSet, trial: Trial, others: Sequence[AxisRecording]
) -> tuple[SharedGains, tuple[Judgement, ...], tuple[Judgement, ...]]:
    """Of all recordings, by fits that each had no part in; what they share is by a fit to all."""
    recordings = [work.equations(run, trial) for run in work.runs]
    common, gains = fit_gains(recordings, work.limits)
    errors_um = held_out_errors(recordings, work.limits)
    judgements = tuple(
        _judge_recording(*recording, common, trial)
        for recording in zip(work.runs, recordings, gains, errors_um, strict=True)
    )
    other_judgements = []
    for run in (average_recording(run, len(others)) for run in others):
        recording = work.equations(run, trial)
        other_judgements.append(
            _judge_recording(
                run, recording, fit_own_gains(recording, common), unseen_errors(recording, common), common, trial
            )
        )
    return common, judgements, tuple(other_judgements)


def _judge_recording(
    run: AveragedRecording, one: Equations, own: Real, error: Real, common: SharedGains, trial: Trial
) -> Judgement:
    residual_um, offsets = model_errors(one, common, own), own[: one.offsets.shape[1]]
    offset_changes = (one.offsets @ offsets)[one.known] - offsets[-1:]
    departures = np.concatenate([residual_um[~one.known], offset_changes, np.zeros(1)])
    known_block = 0 if run.before_v is not None else first_determined_sample(run.drive_v, float(trial.thresholds_v[-1]))
    return Judgement(
        run.name, run.time_s, run.drive_v, run.position_um, error[:, 0], error[:, 1],
        early_errors(run, one, common, own, trial.thresholds_v), residual_um[one.known],
        float(offsets[-1]) if offsets.size else np.nan, float(own[offsets.size :].sum()), run.before_v is not None,
        None if known_block is None else float(run.time_s[known_block]),
        float(np.abs(departures).max()) if offsets.size else np.nan,
    )  # fmt: skip
