"""A Prandtl-Ishlinskii model from recordings as there are: any start, part of a loop, any rate, several at once.

What the actuator remembered at the beginning of a recording is estimated along with the model (`memory_fit`). Plays larger
than half of the longest stroke of known memory (`unknown_memory`) take part, for they move in the recordings, but nothing
tells them from a memory that would have looked alike: they are not written. Drift and creep stay only where they lessen
the error on data that was held out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.design.identification.held_out import fitted, held_out, judged, nearest, own_of
from rtloop.design.identification.identify_hysteresis import (
    LEAST_SLOPE,
    HysteresisFit,
    Placed,
    Placement,
    Weights,
    placed_thresholds,
)
from rtloop.design.identification.measured import Measured, UnsuitableData, noise_of
from rtloop.design.identification.memory_fit import Common, Limits, Own, Stretch, errors, output
from rtloop.design.identification.stretches import Kept, Term, kept, stretch
from rtloop.hil.modal import Real
from rtloop.hysteresis.loop_shape import loop_shape
from rtloop.hysteresis.plays import model_output
from rtloop.hysteresis.unknown_memory import known_from, known_stroke_v, missing_stroke, settled_memory
from rtloop.laws.shipped.play_model import PlayModel

EARNED = 0.95
"""Drift or creep stays where it leaves less than this part of the held-out error."""
LARGER = 6
"""Plays beyond those that are written."""
LEAST_KNOWN = 0.25
"""The longest stroke of known memory is at least this part of the drive's range."""
WHOLE = 0.98
"""A stroke is the whole range from this part of it on."""
UNSETTLED = 0.02
"""Part of its range by which a recording's beginning may depart from a loop that repeats itself."""


@dataclass(frozen=True)
class Judgement:
    """A recording under a model that it had no part in: averaged samples (blocks,), and what was found of its own.

    `known_from_s` is when the memory of all plays that are written is known, None where never; `unsettled_um` how far its
    beginning departs from a loop that repeats itself; `drift_um` the drift over its duration.
    """

    name: str
    time_s: Real
    drive_v: Real
    position_um: Real
    error_um: Real
    offset_um: float
    drift_um: float
    known_from_s: float | None
    unsettled_um: float

    @property
    def range_um(self) -> float:
        return float(np.ptp(self.position_um))

    @property
    def rms_um(self) -> float:
        return float(np.sqrt(np.mean(self.error_um**2)))

    @property
    def max_um(self) -> float:
        return float(np.abs(self.error_um).max())

    @property
    def unsettled(self) -> bool:
        """Its beginning is no part of a loop that repeats itself."""
        return self.unsettled_um > UNSETTLED * self.range_um


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


class _Trial(NamedTuple):
    """Thresholds, those that are written first, and terms; how they were placed."""

    thresholds_v: Real
    written: int
    placed: str
    terms: tuple[Term, ...]


class _Work(NamedTuple):
    runs: Sequence[Kept]
    largest_v: float
    range_um: float
    least_slope: float
    duration_s: float

    def limits(self, trial: _Trial) -> Limits:
        return Limits(trial.thresholds_v, self.least_slope, self.largest_v, self.range_um)

    def stretch(self, run: Kept, trial: _Trial) -> Stretch:
        return stretch(run, trial.thresholds_v, trial.terms, self.duration_s)


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

    `before_v` is the drive of each run since rest, where that is known. Raises UnsuitableData, ValueError for the options.
    """
    work = _work(runs, weights, before_v)
    stroke_v, missing = _require_stroke(runs, work)
    trials = [_trial(count, one, stroke_v, work.largest_v) for one in _placements(placement)]
    if thresholds_v is not None:
        trials = [_given(np.array(thresholds_v, float), stroke_v, work.largest_v, missing)]
    best, tried = _chosen(work, trials)
    stretches, memories = _prepared(work, work.runs, best)
    common, owns = fitted(stretches, memories, work.limits(best))
    found = held_out(stretches, memories, work.limits(best))
    judgements = [_judgement(*one, common, best) for one in zip(work.runs, stretches, owns, found, strict=True)]
    model = PlayModel(best.thresholds_v[: best.written], np.diff(common.slopes[: best.written], prepend=0.0))
    left = np.concatenate([errors(*one) for one in zip(stretches, [common] * len(owns), owns, strict=True)])
    creep_um = max(float(np.ptp(one.creep @ common.creep)) for one in stretches)
    shape = _shape(runs, work, model, judgements, left, best.placed, weights)
    return PartsFit(
        shape, tuple(judgements), tuple(_on_others(work, others, common, best)), best.terms, tried, stroke_v, creep_um, missing
    )


def _work(runs: Sequence[Measured], weights: Weights, before_v: Sequence[npt.ArrayLike | None] | None) -> _Work:
    before = [None] * len(runs) if before_v is None else before_v
    parts = [kept(run, len(runs), one) for run, one in zip(runs, before, strict=True)]
    largest_v = max(float(np.ptp(run.full_v)) for run in parts)
    range_um = max(float(np.ptp(run.position_um)) for run in parts)
    least = LEAST_SLOPE * range_um / largest_v if weights == "invertible" else -np.inf
    return _Work(parts, largest_v, range_um, least, max(float(run.time_s[-1]) for run in parts))


def _placements(placement: Placement) -> tuple[Placed, ...]:
    return ("chebyshev", "chebyshev-from-0") if placement == "auto" else (placement,)


def _trial(count: int, placed: Placed, stroke_v: float, largest_v: float) -> _Trial:
    return _with_larger(placed_thresholds(count, 0.5 * stroke_v, placed), placed, 0.5 * stroke_v, largest_v)


def _with_larger(thresholds: Real, placed: str, from_v: float, largest_v: float) -> _Trial:
    larger = np.linspace(from_v, largest_v, LARGER, endpoint=False)
    return _Trial(np.append(thresholds, larger), thresholds.size, placed, ())


def _given(thresholds: Real, stroke_v: float, largest_v: float, missing: str) -> _Trial:
    if thresholds.size == 0 or not np.all(np.isfinite(thresholds)) or thresholds[0] < 0 or np.any(np.diff(thresholds) <= 0):
        raise ValueError(f"thresholds: {thresholds.tolist()} must be at least 0 and ascend")
    beyond = thresholds[thresholds >= 0.5 * stroke_v]
    if beyond.size:
        raise UnsuitableData(
            f"thresholds from {beyond[0]:g} V on cannot be told: the longest stroke of known memory is {stroke_v:.4g} V, "
            f"which shows plays below {0.5 * stroke_v:.4g} V{f'; {missing}' if missing else ''}"
        )
    return _with_larger(thresholds, "given", 0.5 * stroke_v, largest_v)


def _require_stroke(runs: Sequence[Measured], work: _Work) -> tuple[float, str]:
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
        f"missing: the drive from {reached_v:.4g} V on to {goal_v:.4g} V, in one stroke from {turn_v:.4g} V, by which plays "
        f"from {0.5 * stroke_v:.4g} V up to {0.5 * work.largest_v:.4g} V would show"
    )
    if stroke_v < LEAST_KNOWN * work.largest_v:
        raise UnsuitableData(
            f"{', '.join(run.name for run in runs)}: too little excitation: what the actuator remembers at first is not known, "
            f"and the longest stroke from where it is known has {stroke_v:.4g} V of the {work.largest_v:.4g} V that the drive "
            f"covers; at least {100 * LEAST_KNOWN:g} % are needed; {missing}"
        )
    return stroke_v, missing


def _chosen(work: _Work, trials: Sequence[_Trial]) -> tuple[_Trial, dict[str, float]]:
    """The best placement; then drift, then creep, where each earns its place.

    Within one recording creep cannot: it has the same shape again as what is held out of it, in the one direction of time.
    """
    tried = {trial.placed: _held_out_um(work, trial) for trial in trials}
    best = min(trials, key=lambda trial: tried[trial.placed])
    least = tried[best.placed]
    for term in ("drift", "creep") if len(work.runs) > 1 else ("drift",):
        more = best._replace(terms=(*best.terms, term))
        name = " + ".join((more.placed, *more.terms))
        tried[name] = _held_out_um(work, more)
        if tried[name] < EARNED * least:
            best, least = more, tried[name]
    return best, tried


def _held_out_um(work: _Work, trial: _Trial) -> float:
    """rms of all recordings, each of equal weight."""
    found = held_out(*_prepared(work, work.runs, trial), work.limits(trial))
    return float(np.sqrt(np.mean([np.mean(one**2) for one in found])))


def _prepared(work: _Work, runs: Sequence[Kept], trial: _Trial, common: Common | None = None) -> tuple[list[Stretch], list[Real]]:
    """Equations of every run, and the rises of its memory curve to begin at: settled, level, or half as steep as can be."""
    gaps, found = np.diff(trial.thresholds_v, prepend=0.0), []
    stretches = [work.stretch(run, trial) for run in runs]
    for run, one in zip(runs, stretches, strict=True):
        settled = np.clip(np.diff(settled_memory(run.drive_v, trial.thresholds_v), prepend=run.full_v[0]), -gaps, gaps)
        starts = [settled, np.zeros(gaps.size), 0.5 * gaps, -0.5 * gaps] if run.before_v is None else [settled]
        found.append(nearest(one, starts, work.limits(trial), common))
    return stretches, found


def _on_others(work: _Work, others: Sequence[Measured], common: Common, trial: _Trial) -> list[Judgement]:
    runs = [kept(run, len(others)) for run in others]
    found = []
    for run, one, rises in zip(runs, *_prepared(work, runs, trial, common), strict=True):
        error = judged(one, common, rises, work.limits(trial))
        found.append(_judgement(run, one, own_of(one, common, rises, work.limits(trial)), error, common, trial))
    return found


def _judgement(run: Kept, one: Stretch, own: Own, error: Real, common: Common, trial: _Trial) -> Judgement:
    settled = np.diff(settled_memory(run.drive_v, trial.thresholds_v), prepend=run.full_v[0])
    apart = output(one, common, own) - output(one, common, own._replace(rises=settled))
    known = 0 if run.before_v is not None else known_from(run.drive_v, float(trial.thresholds_v[trial.written - 1]))
    return Judgement(
        run.name, run.time_s, run.drive_v, run.position_um, error, float(own.terms[0]), float(own.terms[1:].sum()),
        None if known is None else float(run.time_s[known]), float(np.abs(apart - apart[-1]).max()),
    )  # fmt: skip


def _shape(
    runs: Sequence[Measured], work: _Work, model: PlayModel, judgements: Sequence[Judgement], left: Real, placed: str,
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
