"""A Prandtl-Ishlinskii model from recordings as there are: any start, part of a loop, any rate, several at once.

Slopes come from the stretches in which the drive stays within what it has covered (`unknown_memory`): there the plays
that move are known, and the others are an offset. Only plays of up to half of the longest such stroke show, and are
written. Drift and creep stay only where they lessen the error on data that was held out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rtloop.design.identification.axis_recording import AxisRecording, UnsuitableData, noise_std, require_rising
from rtloop.design.identification.hysteresis.averaged_recording import Term
from rtloop.design.identification.hysteresis.cross_validation import LEAST_OTHERS, held_out_errors
from rtloop.design.identification.hysteresis.identify_hysteresis import (
    HysteresisFit,
    Weights,
    require_explanation,
)
from rtloop.design.identification.hysteresis.judgement import (
    Judgement,
    RecordingSet,
    Trial,
    fit_and_judge,
    prepare_recordings,
)
from rtloop.design.identification.hysteresis.thresholds import (
    Placement,
    candidate_placements,
    place_thresholds,
    require_ascending,
)
from rtloop.foundation.arrays import Real
from rtloop.hysteresis.loop_shape import loop_shape
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import model_output, turning_points
from rtloop.hysteresis.unknown_memory import missing_stroke

IMPROVED_SHARE = 0.95
"""Drift or creep stays where it leaves less than this part of the held-out error."""
LEAST_STD_ERRORS = 1.0
"""Standard errors over the recordings that creep gains by at least."""
LEAST_KNOWN_SHARE = 0.25
"""The longest stroke of known memory is at least this part of the drive's range."""
WHOLE_SHARE = 0.98
"""A stroke is the whole range from this part of it on."""
TURN_SHARE, LEAST_TURNS = 0.5, 3
"""Drift is looked for in a single recording whose drive turns back so often by this part of its range."""


@dataclass(frozen=True)
class PartsFit:
    """The model that is written, what the recordings are under it, and how it was chosen.

    `tried` holds the held-out error in µm rms of everything that was tried, by its name; `terms` are those that stayed.
    `missing` says what drive would let larger plays be told; empty where none is missing.
    """

    hysteresis: HysteresisFit
    judgements: tuple[Judgement, ...]
    other_judgements: tuple[Judgement, ...]
    terms: tuple[Term, ...]
    trial_errors_um: Mapping[str, float]
    stroke_v: float
    creep_um: float
    missing_drive: str


def identify_from_parts(
    runs: Sequence[AxisRecording],
    count: int = 15,
    placement: Placement = "auto",
    thresholds_v: Sequence[float] | None = None,
    weights: Weights = "invertible",
    other_runs: Sequence[AxisRecording] = (),
    before_v: Sequence[npt.ArrayLike | None] | None = None,
) -> PartsFit:
    """The model of all `runs`, judged on each of them as held out and on `others`, which have no part in it.

    `before_v` is the drive of each run since rest, where that is known. Raises UnsuitableData, ValueError for the
    options.
    """
    for run in runs:
        require_rising(run)
    work = prepare_recordings(runs, weights, before_v)
    stroke_v, missing_drive = _require_stroke(runs, work)
    trials = [
        Trial(place_thresholds(count, 0.5 * stroke_v, rule), rule, ()) for rule in candidate_placements(placement)
    ]
    if thresholds_v is not None:
        trials = [_trial_of_user_thresholds(np.array(thresholds_v, float), stroke_v, missing_drive)]
    trial, errors_um = _choose_trial(work, trials)
    common, judgements, other_judgements = fit_and_judge(work, trial, other_runs)
    residual_um = np.concatenate([rule.residual_um for rule in judgements])
    model = PlayModel(trial.thresholds_v, np.diff(common.slopes, prepend=0.0))
    creep_um = max(float(np.ptp(work.equations(run, trial).creep @ common.creep)) for run in work.runs)
    hysteresis = require_explanation(
        _hysteresis_fit(runs, work, model, judgements, residual_um, trial.placement, weights), runs
    )
    return PartsFit(hysteresis, judgements, other_judgements, trial.terms, errors_um, stroke_v, creep_um, missing_drive)


def _trial_of_user_thresholds(thresholds: Real, stroke_v: float, missing: str) -> Trial:
    require_ascending(thresholds)
    too_large = thresholds[thresholds >= 0.5 * stroke_v]
    if too_large.size:
        raise UnsuitableData(
            f"thresholds from {too_large[0]:g} V on cannot be told: the longest stroke of known memory has "
            f"{stroke_v:.4g} "
            f"V and shows plays below {0.5 * stroke_v:.4g} V{f'; {missing}' if missing else ''}"
        )
    return Trial(thresholds, "given", ())


def _require_stroke(runs: Sequence[AxisRecording], work: RecordingSet) -> tuple[float, str]:
    """The longest stroke of known memory, and what is missing to the whole range. Raises UnsuitableData."""
    stroke_v = max(run.stroke_v for run in work.runs)
    if stroke_v >= WHOLE_SHARE * work.largest_v:
        return stroke_v, ""
    widest = max(work.runs, key=lambda run: float(np.ptp(run.full_v)))
    turn_v, reached_v, goal_v = missing_stroke(widest.full_v)
    hint = (
        f"missing: the drive from {reached_v:.4g} V on to {goal_v:.4g} V, in one stroke from {turn_v:.4g} V, which "
        f"would show plays from {0.5 * stroke_v:.4g} V up to {0.5 * work.largest_v:.4g} V"
    )
    if stroke_v < LEAST_KNOWN_SHARE * work.largest_v:
        raise UnsuitableData(
            f"{', '.join(run.name for run in runs)}: too little excitation: what the actuator remembers at first is "
            f"not known, and the longest stroke from where it is known has {stroke_v:.4g} V of the "
            f"{work.largest_v:.4g} V that the drive covers; at least {100 * LEAST_KNOWN_SHARE:g} % are needed; {hint}"
        )
    return stroke_v, hint


def _choose_trial(work: RecordingSet, trials: Sequence[Trial]) -> tuple[Trial, dict[str, float]]:
    """The best placement; then drift, then creep, where each earns its place."""
    squares_by_name = {trial.placement: _held_out_squares(work, trial) for trial in trials}
    best = min(trials, key=lambda trial: float(np.mean(squares_by_name[trial.placement])))
    least_squares = squares_by_name[best.placement]
    for term in _candidate_terms(work):
        extended = best._replace(terms=(*best.terms, term))
        name = " + ".join((extended.placement, *extended.terms))
        squares_by_name[name] = _held_out_squares(work, extended)
        if _lowers_error(squares_by_name[name], least_squares) and (
            term != "creep" or _is_lag_over_time(work, extended, name, squares_by_name, least_squares)
        ):
            best, least_squares = extended, squares_by_name[name]
    return best, {name: float(np.sqrt(np.mean(squares))) for name, squares in squares_by_name.items()}


def _lowers_error(squares: Real, without: Real) -> bool:
    return bool(np.mean(squares) < IMPROVED_SHARE**2 * np.mean(without))


def _is_lag_over_time(work: RecordingSet, trial: Trial, name: str, found: dict[str, Real], without: Real) -> bool:
    """Whether all recordings have creep, and whether it is no memory that fades with the drive's path.

    An actuator that is no sum of plays may have one (Bouc and Wen's is a lag by path), and the weights that are left
    beside it would be no model of it. A drive of one speed cannot tell the two.
    """
    path_name = f"{name} by path"
    found[path_name] = _held_out_squares(work, trial._replace(clock="path"))
    gains = [reference_value - found[name] for reference_value in (without, found[path_name])]
    is_certain = all(np.mean(gain) > LEAST_STD_ERRORS * np.std(gain, ddof=1) / gain.size**0.5 for gain in gains)
    return is_certain and _lowers_error(found[name], found[path_name])


def _candidate_terms(work: RecordingSet) -> tuple[Term, ...]:
    """Terms that data could tell: a drive that comes by once looks alike with drift and with other weights, and creep
    takes the shape of a recording unless that is left out whole."""
    if len(work.runs) > 1:
        return ("drift", "creep") if len(work.runs) > LEAST_OTHERS else ("drift",)
    drive = work.runs[0].drive_v
    return ("drift",) if turning_points(drive, TURN_SHARE * float(np.ptp(drive))).size >= LEAST_TURNS else ()


def _held_out_squares(work: RecordingSet, trial: Trial) -> Real:
    """Mean square of the errors held out of each recording that is judged (runs,)."""
    errors_um = held_out_errors([work.equations(run, trial) for run in work.runs], work.limits)
    return np.array([float(np.nanmean(error_um[:, 0] ** 2)) for error_um in errors_um if np.any(np.isfinite(error_um))])


def _hysteresis_fit(
    runs: Sequence[AxisRecording], work: RecordingSet, model: PlayModel, judgements: Sequence[Judgement], left: Real,
    placed: str, weights: Weights,
) -> HysteresisFit:  # fmt: skip
    widest = max(runs, key=lambda run: float(np.ptp(run.drive_v)))
    noises = [
        noise_std(run.position_um) ** 2 / averaged_run.size for run, averaged_run in zip(runs, work.runs, strict=True)
    ]
    return HysteresisFit(
        model,
        tuple(judgement.offset_um for judgement in judgements),
        float(np.sqrt(np.mean(left**2))),
        float(np.abs(left).max()),
        float(np.sqrt(np.mean(noises))),
        work.range_um,
        max(float(np.abs(run.drive_v).max()) for run in runs),
        loop_shape(widest.drive_v[:-1], widest.position_um[1:]),
        loop_shape(widest.drive_v, model_output(model, widest.drive_v)),
        placed,
        weights,
        work.least_slope,
    )
