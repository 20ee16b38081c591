"""A Prandtl-Ishlinskii model from any recordings: with any start, of parts of a loop, at any rate, several together.

Slopes come from the stretches in which the drive stays within the range that it has covered (`unknown_memory`): there
the moving plays are known, and the resting plays are an offset. Only plays of up to half of the longest such stroke
move, and are written. Drift and creep are kept only if they lower the held-out error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rtloop.design.identification.axis_recording import AxisRecording, UnsuitableData, require_rising
from rtloop.design.identification.hysteresis.averaged_recording import Term
from rtloop.design.identification.hysteresis.cross_validation import LEAST_OTHERS, cross_validate
from rtloop.design.identification.hysteresis.judgement import Judgement, fit_and_judge
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
from rtloop.foundation.arrays import Real
from rtloop.hysteresis.plays import turning_points
from rtloop.hysteresis.unknown_memory import missing_stroke

IMPROVED_SHARE = 0.95
"""Fraction of the held-out rms error below which drift or creep must lower it, for the term to be kept."""
LEAST_STD_ERRORS = 1.0
"""Least gain by creep, in standard errors over the recordings."""
LEAST_KNOWN_SHARE = 0.25
"""Least length of the longest stroke of known memory, as a fraction of the drive's range."""
WHOLE_SHARE = 0.98
"""Least fraction of the drive's range that counts as all of it."""
TURN_SHARE, LEAST_TURNS = 0.5, 3
"""Drift is tried in a single recording whose drive turns at least LEAST_TURNS times by TURN_SHARE of its range."""


@dataclass(frozen=True)
class PartsFit:
    """Model to write, judgement of each recording under it, and the choice of its terms.

    `trial_errors_um` has the held-out error in µm rms of each trial, by name, `terms` the kept terms ("drift",
    "creep"), which lowered this error, `creep_um` the range of creep, 0 without it. `stroke_v` is the longest stroke of
    known memory; `missing_drive` names the drive that would show larger plays, "" if the stroke covers the range.
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
    """Identify one model from all `runs`; judge it on each of them held out, and on `other_runs`, which are not fitted.

    `before_v` has for each run the drive in V from rest to its first tick, None if unknown; `count`, `placement`,
    `thresholds_v` and `weights` are as in `identify_hysteresis`. Raises UnsuitableData for a wrong sign, for too short
    a stroke of known memory, for thresholds of half of this stroke or more, and if no model explains the runs;
    ValueError for a wrong `count`, `placement` or `thresholds_v`.
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
    creep_um = max(float(np.ptp(work.equations(run, trial).creep @ common.creep)) for run in work.runs)
    offsets_um = [judgement.offset_um for judgement in judgements]
    hysteresis = work.require_explanation(work.describe_fit(trial, common.slopes, offsets_um, residual_um))
    return PartsFit(hysteresis, judgements, other_judgements, trial.terms, errors_um, stroke_v, creep_um, missing_drive)


def _trial_of_user_thresholds(thresholds: Real, stroke_v: float, hint: str) -> Trial:
    """Return the trial of the user's thresholds (V), without drift and creep.

    Raises ValueError if they do not ascend, UnsuitableData, with `hint` at its end, for a threshold of half of
    `stroke_v` or more.
    """
    require_ascending(thresholds)
    too_large = thresholds[thresholds >= 0.5 * stroke_v]
    if too_large.size:
        raise UnsuitableData(
            f"thresholds: value is {too_large[0]:g} V; allowed: below {0.5 * stroke_v:.4g} V, half of the longest "
            f"stroke of the drive ({stroke_v:.4g} V) over which the actuator's memory is known"
            f"{f'; {hint}' if hint else ''}"
        )
    return Trial(thresholds, "given", ())


def _require_stroke(runs: Sequence[AxisRecording], work: RecordingSet) -> tuple[float, str]:
    """Return the longest stroke of known memory in V, and a text that names the stroke to record for larger thresholds.

    The text is "" if the stroke reaches WHOLE_SHARE of the largest range of drive of the runs. Raises UnsuitableData if
    it is shorter than LEAST_KNOWN_SHARE of that range.
    """
    stroke_v = max(run.stroke_v for run in work.runs)
    if stroke_v >= WHOLE_SHARE * work.largest_v:
        return stroke_v, ""
    widest = max(work.runs, key=lambda run: float(np.ptp(run.full_v)))
    turn_v, reached_v, goal_v = missing_stroke(widest.full_v)
    hint = (
        f"a stroke from {turn_v:.4g} V to {goal_v:.4g} V is not recorded (the drive reached only {reached_v:.4g} V); "
        f"this stroke would show thresholds from {0.5 * stroke_v:.4g} V up to {0.5 * work.largest_v:.4g} V"
    )
    if stroke_v < LEAST_KNOWN_SHARE * work.largest_v:
        raise UnsuitableData(
            f"{', '.join(run.name for run in runs)}: too little excitation: the actuator's memory is known over "
            f"strokes of the drive of up to {stroke_v:.4g} V; allowed: at least "
            f"{LEAST_KNOWN_SHARE * work.largest_v:.4g} V ({100 * LEAST_KNOWN_SHARE:g} % of the drive's range); {hint}. "
            "Record this stroke"
        )
    return stroke_v, hint


def _choose_trial(work: RecordingSet, trials: Sequence[Trial]) -> tuple[Trial, dict[str, float]]:
    """Choose the placement of least held-out error, then add drift, then creep, each if the term lowers the error below
    IMPROVED_SHARE of the error without it; creep also needs `_is_lag_over_time`.

    Returns the chosen trial and the held-out rms error in µm of every trial, by a name of placement and terms such as
    "chebyshev + drift + creep", with " by path" for creep over the drive's path.
    """
    squares_by_name = {trial.placement: _mean_squares(work, trial) for trial in trials}
    best_trial = min(trials, key=lambda trial: float(np.mean(squares_by_name[trial.placement])))
    least_squares = squares_by_name[best_trial.placement]
    for term in _candidate_terms(work):
        extended = best_trial._replace(terms=(*best_trial.terms, term))
        name = " + ".join((extended.placement, *extended.terms))
        squares_by_name[name] = _mean_squares(work, extended)
        if _lowers_error(squares_by_name[name], least_squares) and (
            term != "creep" or _is_lag_over_time(work, extended, name, squares_by_name, least_squares)
        ):
            best_trial, least_squares = extended, squares_by_name[name]
    return best_trial, {name: float(np.sqrt(np.mean(squares))) for name, squares in squares_by_name.items()}


def _lowers_error(squares: Real, reference_squares: Real) -> bool:
    """Whether the root mean of `squares` is below IMPROVED_SHARE times the root mean of `reference_squares`."""
    return bool(np.mean(squares) < IMPROVED_SHARE**2 * np.mean(reference_squares))


def _is_lag_over_time(
    work: RecordingSet, trial: Trial, name: str, squares_by_name: dict[str, Real], reference_squares: Real
) -> bool:
    """Whether the error with creep is less than the error without it, and less than the error with a memory that fades
    with the drive's path: both by more than LEAST_STD_ERRORS standard errors over the recordings, the second also below
    IMPROVED_SHARE of that error.

    `squares_by_name` has the mean square errors of `trial`, which includes creep, under `name`; this function adds the
    errors with a memory by path under "NAME by path". An actuator that is no sum of plays may have such a memory (Bouc
    and Wen's is a lag by path); weights fitted beside it would not model it. A drive of one speed cannot tell the two
    apart.
    """
    path_name = f"{name} by path"
    squares_by_name[path_name] = _mean_squares(work, trial._replace(clock="path"))
    gains = [
        reference_value - squares_by_name[name] for reference_value in (reference_squares, squares_by_name[path_name])
    ]
    is_certain = all(np.mean(gain) > LEAST_STD_ERRORS * np.std(gain, ddof=1) / gain.size**0.5 for gain in gains)
    return is_certain and _lowers_error(squares_by_name[name], squares_by_name[path_name])


def _candidate_terms(work: RecordingSet) -> tuple[Term, ...]:
    """Return the terms that the data can identify: "drift" for several runs, or for one whose drive turns LEAST_TURNS
    times or more, by TURN_SHARE of its range; "creep" too for more than LEAST_OTHERS runs.

    A drive that passes once fits drift and other weights alike; creep fits any single recording, unless it is held out.
    """
    if len(work.runs) > 1:
        return ("drift", "creep") if len(work.runs) > LEAST_OTHERS else ("drift",)
    drive = work.runs[0].drive_v
    return ("drift",) if turning_points(drive, TURN_SHARE * float(np.ptp(drive))).size >= LEAST_TURNS else ()


def _mean_squares(work: RecordingSet, trial: Trial) -> Real:
    """Return the mean square in µm² of the whole model's held-out errors, of each recording that has any, in the order
    of the runs.
    """
    errors_um = cross_validate([work.equations(run, trial) for run in work.runs], work.limits)
    return np.array([float(np.nanmean(error_um[:, 0] ** 2)) for error_um in errors_um if np.any(np.isfinite(error_um))])
