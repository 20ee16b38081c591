"""Judgement of recordings under a sum of plays fitted to other data: held-out errors, offset, drift, memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rtloop.design.identification.axis_recording import AxisRecording
from rtloop.design.identification.hysteresis.averaged_recording import AveragedRecording, average_recording
from rtloop.design.identification.hysteresis.cross_validation import cross_validate, unseen_errors
from rtloop.design.identification.hysteresis.early_errors import early_errors
from rtloop.design.identification.hysteresis.least_squares import (
    Equations,
    SharedGains,
    fit_gains,
    fit_own_gains,
    model_errors,
)
from rtloop.design.identification.hysteresis.recording_set import (
    HysteresisFit,
    RecordingSet,
    Trial,
    prepare_recordings,
)
from rtloop.foundation.arrays import Real
from rtloop.hysteresis.unknown_memory import first_determined_sample

UNSETTLED_SHARE = 0.08
"""Largest departure of a recording's beginning from a periodic loop, as a fraction of its range. Scanners whose
branches differ in shape, or that creep, depart by half of it where their loops close.
"""


@dataclass(frozen=True)
class Judgement:
    """Recording judged under a model fitted to other recordings or pieces: averaged samples (blocks,), and figures.

    `error_um` is held out, NaN where the memory is not known; `written_error_um` is the error of the written plays
    alone, without drift and creep; `early_error_um` is the error of the other blocks, with a memory estimated for them
    (`early_errors`), NaN elsewhere. `residual_um` is the residual of the fit to the blocks of known memory. `offset_um`
    is the offset in the recording's last stretch. `starts_from_rest`: the initial memory was given. `known_from_s` is
    the time from which the memory of all plays is known, None if never. `unsettled_um` is the departure of the
    beginning from a periodic loop; `drift_um` the drift over the duration.
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
        """Range covered by the averaged position, in µm."""
        return float(np.ptp(self.position_um))

    @property
    def known_share(self) -> float:
        """Fraction of the recording's blocks with known memory, the only ones that are judged."""
        return float(np.mean(np.isfinite(self.error_um)))

    @property
    def rms_um(self) -> float:
        """Rms of the held-out errors in µm; NaN without any."""
        return float(np.sqrt(np.nanmean(self.error_um**2))) if self.known_share else np.nan

    @property
    def rms_of_plays_um(self) -> float:
        """Rms of the held-out errors of the written plays alone, in µm; NaN without any."""
        return float(np.sqrt(np.nanmean(self.written_error_um**2))) if self.known_share else np.nan

    @property
    def max_um(self) -> float:
        """Largest held-out error in magnitude, in µm; NaN without any."""
        return float(np.nanmax(np.abs(self.error_um))) if self.known_share else np.nan

    @property
    def early_max_um(self) -> float:
        """Largest error in magnitude where the memory is not known, in µm; NaN without any."""
        return float(np.nanmax(np.abs(self.early_error_um))) if np.isfinite(self.early_error_um).any() else np.nan

    @property
    def is_unsettled(self) -> bool:
        """Whether the beginning departs from a periodic loop by more than UNSETTLED_SHARE of the range; False where it
        starts from rest.
        """
        return not self.starts_from_rest and self.unsettled_um > UNSETTLED_SHARE * self.range_um


class CombinedError(NamedTuple):
    """Error in µm rms over recordings of equal weight, and its standard error from their spread; None for fewer than
    two.

    Delta method: var(rms) = var(mean square)/(4 rms²). It is too small for recordings of few strokes, whose errors
    spread unevenly.
    """

    rms_um: float
    std_um: float | None


def combine_errors(rms_um: Sequence[float]) -> CombinedError:
    """Return the root of the mean square of several recordings' rms errors; NaN entries are ignored.

    `rms_um` is NaN without a finite entry, `std_um` None with fewer than two.
    """
    squares = np.square([value for value in rms_um if np.isfinite(value)])
    rms = float(np.sqrt(squares.mean())) if squares.size else np.nan
    if squares.size < 2:
        return CombinedError(rms, None)
    return CombinedError(rms, float(np.std(squares, ddof=1) / squares.size**0.5 / max(2 * rms, 1e-300)))


def evaluate_from_rest(
    runs: Sequence[AxisRecording], shape: HysteresisFit, other_runs: Sequence[AxisRecording] = ()
) -> tuple[tuple[Judgement, ...], tuple[Judgement, ...]]:
    """Judge `runs`, each from rest, by held-out errors (`cross_validate`), and `other_runs`, whose memory is unknown,
    by the fit to `runs`.

    Only thresholds and kind of weights come from `shape`; the weights are fitted anew. `runs` are not checked: they
    must have passed `identify_hysteresis`. Returns the judgements of `runs` and the judgements of `other_runs`.
    """
    recordings = prepare_recordings(runs, shape.weights, [np.zeros(1)] * len(runs))
    trial = Trial(shape.model.thresholds, shape.placement, ())
    return fit_and_judge(recordings, trial, other_runs)[1:]


def fit_and_judge(
    recording_set: RecordingSet, trial: Trial, other_runs: Sequence[AxisRecording]
) -> tuple[SharedGains, tuple[Judgement, ...], tuple[Judgement, ...]]:
    """Fit all recordings of the set and judge each by its held-out errors (`cross_validate`).

    Returns the common gains, the judgements of `recording_set.runs`, and the judgements of `other_runs`, which take no
    part in the fit of the common gains.
    """
    recordings = [recording_set.equations(run, trial) for run in recording_set.runs]
    common, gains = fit_gains(recordings, recording_set.limits)
    errors_um = cross_validate(recordings, recording_set.limits)
    judgements = tuple(
        _judge_recording(*recording, common, trial)
        for recording in zip(recording_set.runs, recordings, gains, errors_um, strict=True)
    )
    other_judgements = []
    for run in (average_recording(run, len(other_runs)) for run in other_runs):
        recording = recording_set.equations(run, trial)
        other_judgements.append(
            _judge_recording(
                run, recording, fit_own_gains(recording, common), unseen_errors(recording, common), common, trial
            )
        )
    return common, judgements, tuple(other_judgements)


def _judge_recording(
    run: AveragedRecording, recording: Equations, own_gains: Real, error: Real, common: SharedGains, trial: Trial
) -> Judgement:
    """Return the judgement of one recording from its offsets and drift, `own_gains`, and its held-out errors, `error`
    (blocks, 2), of the whole model and of the plays alone.
    """
    residual_um, offsets = model_errors(recording, common, own_gains), own_gains[: recording.offsets.shape[1]]
    offset_changes = (recording.offsets @ offsets)[recording.is_known] - offsets[-1:]
    departures = np.concatenate([residual_um[~recording.is_known], offset_changes, np.zeros(1)])
    known_block = 0 if run.before_v is not None else first_determined_sample(run.drive_v, float(trial.thresholds_v[-1]))
    return Judgement(
        run.name, run.time_s, run.drive_v, run.position_um, error[:, 0], error[:, 1],
        early_errors(run, recording, common, own_gains, trial.thresholds_v),
        residual_um[recording.is_known], float(offsets[-1]) if offsets.size else np.nan,
        float(own_gains[offsets.size :].sum()), run.before_v is not None,
        None if known_block is None else float(run.time_s[known_block]),
        float(np.abs(departures).max()) if offsets.size else np.nan,
    )  # fmt: skip
