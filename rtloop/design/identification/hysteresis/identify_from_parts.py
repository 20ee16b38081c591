"""A Prandtl-Ishlinskii model from recordings as there are: any start, part of a loop, any rate, several at once.

What the actuator remembered at the beginning of a recording is estimated along with the model (`memory_fit`). Plays
larger than half of the longest stroke of known memory (`unknown_memory`) take part, for they move in the recordings,
but nothing tells them from a memory that would have looked alike: they are not written. Drift and creep stay only
where they lessen the error on data that was held out, creep more than the same lags by the drive's path do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rtloop.design.identification.hysteresis.held_out import held_out
from rtloop.design.identification.hysteresis.identify_hysteresis import (
    HysteresisFit,
    Placed,
    Placement,
    Weights,
    placed_thresholds,
)
from rtloop.design.identification.hysteresis.judgement import (
    Judgement,
    Trial,
    Work,
    judgements_of,
    prepared,
    prepared_work,
)
from rtloop.design.identification.hysteresis.stretches import Term
from rtloop.design.identification.measured import Measured, UnsuitableData, noise_of
from rtloop.hil.modal import Real
from rtloop.hysteresis.loop_shape import loop_shape
from rtloop.hysteresis.plays import model_output, turning_points
from rtloop.hysteresis.unknown_memory import known_stroke_v, missing_stroke
from rtloop.laws.shipped.play_model import PlayModel

EARNED = 0.95
"""Drift or creep stays where it leaves less than this part of the held-out error."""
SURELY = 1.0
"""Standard errors over the recordings that creep gains by at least."""
LARGER = 6
"""Plays beyond those that are written."""
LEAST_KNOWN = 0.25
"""The longest stroke of known memory is at least this part of the drive's range."""
WHOLE = 0.98
"""A stroke is the whole range from this part of it on."""
REPEATED, LEAST_TURNS = 0.5, 3
"""Drift is looked for in a single recording whose drive turns back so often by this part of its range."""


@dataclass(frozen=True)
class PartsFit:
    """The model that is written, what the recordings are under it, and how it was chosen.

    `tried` holds the held-out error in µm rms of everything that was tried, by its name; `terms` are those that stayed.
    `missing` says what drive would let larger plays be told; empty where none is missing.
    """

    shape: HysteresisFit
    judgements: tuple[Judgement, ...]
    others: tuple[Judgement, ...]
    terms: tuple[Term, ...]
    tried: Mapping[str, float]
    stroke_v: float
    creep_um: float
    missing: str


def identify_from_parts(
    runs: Sequence[Measured],
    count: int = 15,
    placement: Placement = "auto",
    thresholds_v: Sequence[float] | None = None,
    weights: Weights = "invertible",
    others: Sequence[Measured] = (),
    before_v: Sequence[npt.ArrayLike | None] | None = None,
) -> PartsFit:
    """The model of all `runs`, judged on each of them as held out and on `others`, which have no part in it.

    `before_v` is the drive of each run since rest, where that is known. Raises UnsuitableData, ValueError for the
    options.
    """
    work = prepared_work(runs, weights, before_v)
    stroke_v, missing = _require_stroke(runs, work)
    trials = [_trial(count, one, stroke_v, work.largest_v) for one in _placements(placement)]
    if thresholds_v is not None:
        trials = [_given(np.array(thresholds_v, float), stroke_v, work.largest_v, missing)]
    best, tried = _chosen(work, trials)
    common, judgements, on_others = judgements_of(work, best, others)
    left = np.concatenate([one.left_um for one in judgements])
    model = PlayModel(best.thresholds_v[: best.written], np.diff(common.slopes[: best.written], prepend=0.0))
    creep_um = max(float(np.ptp(work.stretch(run, best).creep @ common.creep)) for run in work.runs)
    shape = _shape(runs, work, model, judgements, left, best.placed, weights)
    return PartsFit(shape, judgements, on_others, best.terms, tried, stroke_v, creep_um, missing)


def _placements(placement: Placement) -> tuple[Placed, ...]:
    return ("chebyshev", "chebyshev-from-0") if placement == "auto" else (placement,)


def _trial(count: int, placed: Placed, stroke_v: float, largest_v: float) -> Trial:
    return _with_larger(placed_thresholds(count, 0.5 * stroke_v, placed), placed, 0.5 * stroke_v, largest_v)


def _with_larger(thresholds: Real, placed: str, from_v: float, largest_v: float) -> Trial:
    larger = np.linspace(from_v, largest_v, LARGER, endpoint=False)
    return Trial(np.append(thresholds, larger), thresholds.size, placed, ())


def _given(thresholds: Real, stroke_v: float, largest_v: float, missing: str) -> Trial:
    if (
        thresholds.size == 0
        or not np.all(np.isfinite(thresholds))
        or thresholds[0] < 0
        or np.any(np.diff(thresholds) <= 0)
    ):
        raise ValueError(f"thresholds: {thresholds.tolist()} must be at least 0 and ascend")
    beyond = thresholds[thresholds >= 0.5 * stroke_v]
    if beyond.size:
        raise UnsuitableData(
            f"thresholds from {beyond[0]:g} V on cannot be told: the longest stroke of known memory has {stroke_v:.4g} "
            f"V and shows plays below {0.5 * stroke_v:.4g} V{f'; {missing}' if missing else ''}"
        )
    return _with_larger(thresholds, "given", 0.5 * stroke_v, largest_v)


def _require_stroke(runs: Sequence[Measured], work: Work) -> tuple[float, str]:
    """The longest stroke of known memory, and what is missing to the whole range. Raises UnsuitableData."""
    known = [run.before_v is not None for run in work.runs]
    strokes = [
        2 * float(np.abs(run.full_v).max()) if rest else known_stroke_v(run.full_v)
        for run, rest in zip(work.runs, known, strict=True)
    ]
    stroke_v = min(max(strokes), work.largest_v)
    if stroke_v >= WHOLE * work.largest_v:
        return stroke_v, ""
    widest = max(work.runs, key=lambda run: float(np.ptp(run.full_v)))
    turn_v, reached_v, goal_v = missing_stroke(widest.full_v)
    missing = (
        f"missing: the drive from {reached_v:.4g} V on to {goal_v:.4g} V, in one stroke from {turn_v:.4g} V, which "
        f"would show plays from {0.5 * stroke_v:.4g} V up to {0.5 * work.largest_v:.4g} V"
    )
    if stroke_v < LEAST_KNOWN * work.largest_v:
        raise UnsuitableData(
            f"{', '.join(run.name for run in runs)}: too little excitation: what the actuator remembers at first is "
            f"not known, and the longest stroke from where it is known has {stroke_v:.4g} V of the "
            f"{work.largest_v:.4g} V that the drive covers; at least {100 * LEAST_KNOWN:g} % are needed; {missing}"
        )
    return stroke_v, missing


def _chosen(work: Work, trials: Sequence[Trial]) -> tuple[Trial, dict[str, float]]:
    """The best placement; then drift, then creep, where each earns its place."""
    found = {trial.placed: _squares(work, trial) for trial in trials}
    best = min(trials, key=lambda trial: float(np.mean(found[trial.placed])))
    least = found[best.placed]
    for term in _candidates(work):
        more = best._replace(terms=(*best.terms, term))
        name = " + ".join((more.placed, *more.terms))
        found[name] = _squares(work, more)
        if _earned(found[name], least) and (term != "creep" or _takes_time(work, more, name, found, least)):
            best, least = more, found[name]
    return best, {name: float(np.sqrt(np.mean(squares))) for name, squares in found.items()}


def _earned(squares: Real, without: Real) -> bool:
    return bool(np.mean(squares) < EARNED**2 * np.mean(without))


def _takes_time(work: Work, trial: Trial, name: str, found: dict[str, Real], without: Real) -> bool:
    """Whether all recordings have creep, and whether it is no memory that fades with the drive's path.

    An actuator that is no sum of plays may have one (Bouc and Wen's is a lag by path), and the weights that are left
    beside it would be no model of it. A drive of one speed cannot tell the two.
    """
    by_path = f"{name} by path"
    found[by_path] = _squares(work, trial._replace(clock="path"))
    gains = [other - found[name] for other in (without, found[by_path])]
    sure = all(np.mean(gain) > SURELY * np.std(gain, ddof=1) / gain.size**0.5 for gain in gains)
    return sure and _earned(found[name], found[by_path])


def _candidates(work: Work) -> tuple[Term, ...]:
    """Terms that data could tell: a drive that comes by once looks alike with drift and with other weights, and creep
    takes the shape of one recording whatever it is held out of."""
    if len(work.runs) > 1:
        return "drift", "creep"
    drive = work.runs[0].drive_v
    return ("drift",) if turning_points(drive, REPEATED * float(np.ptp(drive))).size >= LEAST_TURNS else ()


def _squares(work: Work, trial: Trial) -> Real:
    """Mean square of the errors held out of each recording (runs,)."""
    found = held_out(*prepared(work, work.runs, trial), work.limits(trial))
    return np.array([float(np.mean(one**2)) for one in found])


def _shape(
    runs: Sequence[Measured], work: Work, model: PlayModel, judgements: Sequence[Judgement], left: Real, placed: str,
    weights: Weights,
) -> HysteresisFit:  # fmt: skip
    widest = max(runs, key=lambda run: float(np.ptp(run.drive_v)))
    noises = [noise_of(run.position_um) ** 2 / part.size for run, part in zip(runs, work.runs, strict=True)]
    return HysteresisFit(
        model,
        tuple(one.offset_um for one in judgements),
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
