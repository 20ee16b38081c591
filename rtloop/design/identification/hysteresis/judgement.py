"""What recordings are under a sum of plays that they had no part in: errors as held out, offset, drift, memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.design.identification.hysteresis.held_out import (
    Held,
    errors_as_written,
    errors_held_out,
    fits_held_out,
    fitted,
    judged,
    nearest,
    own_of,
)
from rtloop.design.identification.hysteresis.identify_hysteresis import LEAST_SLOPE, HysteresisFit, Weights
from rtloop.design.identification.hysteresis.memory_fit import Common, Limits, Own, Stretch, errors, output
from rtloop.design.identification.hysteresis.stretches import Clock, Kept, Term, kept, stretch
from rtloop.design.identification.measured import Measured
from rtloop.hil.modal import Real
from rtloop.hysteresis.unknown_memory import known_from, settled_memory

UNSETTLED = 0.08
"""Part of its range by which a recording's beginning may depart from a loop that repeats itself: scanners whose
branches differ in shape, or creep, depart by half of it where their loops close."""

LEAST_SHOWN = 0.25
"""Part of a recording, of known memory, that the plays as written are judged on."""


@dataclass(frozen=True)
class Judgement:
    """A recording under a model that it had no part in: averaged samples (blocks,), and what was found of its own.

    `error_um` is held out; `as_written_um` as well, of the plays that are written alone, without drift and creep, from
    where their memory is known (fewer blocks, None where too few); `left_um` is what the model that is fitted to all
    leaves of the recording. `from_rest` says that
    its memory was given; else it was estimated. `known_from_s` is when the memory of all plays that are written is
    known, None where never; `unsettled_um` how far its beginning departs from a loop that repeats itself; `drift_um`
    the drift over its duration.
    """

    name: str
    time_s: Real
    drive_v: Real
    position_um: Real
    error_um: Real
    as_written_um: Real | None
    left_um: Real
    offset_um: float
    drift_um: float
    from_rest: bool
    known_from_s: float | None
    unsettled_um: float

    @property
    def range_um(self) -> float:
        """What the position covers."""
        return float(np.ptp(self.position_um))

    @property
    def rms_um(self) -> float:
        """Of the errors as held out."""
        return float(np.sqrt(np.mean(self.error_um**2)))

    @property
    def as_written_rms_um(self) -> float | None:
        """Of the plays that are written."""
        return None if self.as_written_um is None else float(np.sqrt(np.mean(self.as_written_um**2)))

    @property
    def max_um(self) -> float:
        """The largest error as held out."""
        return float(np.abs(self.error_um).max())

    @property
    def unsettled(self) -> bool:
        """Its beginning is no part of a loop that repeats itself."""
        return not self.from_rest and self.unsettled_um > UNSETTLED * self.range_um


class Spread(NamedTuple):
    """An error in µm rms over recordings of equal weight, and its standard error by their spread; None of a single one.

    Delta method: var(rms) = var(mean square)/(4 rms²). Recordings of few strokes spread so unevenly that it is too
    small.
    """

    rms_um: float
    std_um: float | None


def together(rms_um: Sequence[float]) -> Spread:
    """Of the errors of several recordings."""
    squares = np.square(rms_um)
    rms = float(np.sqrt(squares.mean()))
    if squares.size == 1:
        return Spread(rms, None)
    return Spread(rms, float(np.std(squares, ddof=1) / squares.size**0.5 / max(2 * rms, 1e-300)))


class Trial(NamedTuple):
    """Thresholds, those that are written first, and terms; how they were placed, what creep goes by."""

    thresholds_v: Real
    written: int
    placed: str
    terms: tuple[Term, ...]
    clock: Clock = "time"


class Work(NamedTuple):
    """Recordings that share a model, the largest ranges of drive and position among them, the least slope, the
    longest time and path of the drive."""

    runs: Sequence[Kept]
    largest_v: float
    range_um: float
    least_slope: float
    duration_s: float
    path_v: float

    def limits(self, trial: Trial) -> Limits:
        """Of a fit."""
        return Limits(trial.thresholds_v, self.least_slope, self.largest_v, self.range_um)

    def stretch(self, run: Kept, trial: Trial) -> Stretch:
        """The equations of one recording."""
        return stretch(run, trial.thresholds_v, trial.terms, trial.clock, self.duration_s, self.path_v)


def judged_from_rest(
    runs: Sequence[Measured], shape: HysteresisFit, others: Sequence[Measured] = ()
) -> tuple[tuple[Judgement, ...], tuple[Judgement, ...]]:
    """`runs`, each from rest and held out in turn, and `others`, of unknown memory, under plays placed as in
    `shape`."""
    work = prepared_work(runs, shape.weights, [np.zeros(1)] * len(runs))
    trial = Trial(shape.model.thresholds, shape.model.thresholds.size, shape.placement, ())
    return judgements_of(work, trial, others)[1:]


def prepared_work(runs: Sequence[Measured], weights: Weights, before_v: Sequence[npt.ArrayLike | None] | None) -> Work:
    """Recordings, averaged; `before_v` is the drive of each since rest, where that is known."""
    before = [None] * len(runs) if before_v is None else before_v
    parts = [kept(run, len(runs), one) for run, one in zip(runs, before, strict=True)]
    largest_v = max(float(np.ptp(run.full_v)) for run in parts)
    range_um = max(float(np.ptp(run.position_um)) for run in parts)
    least = LEAST_SLOPE * range_um / largest_v if weights == "invertible" else -np.inf
    duration_s, path_v = np.max([(run.time_s[-1], run.path_v[-1]) for run in parts], axis=0).tolist()
    return Work(parts, largest_v, range_um, least, duration_s, path_v)


def prepared(
    work: Work, runs: Sequence[Kept], trial: Trial, common: Common | None = None
) -> tuple[list[Stretch], list[Real]]:
    """Equations of every run, and the rises of its memory curve to begin at: settled, level, or half as steep as can
    be."""
    gaps, found = np.diff(trial.thresholds_v, prepend=0.0), []
    stretches = [work.stretch(run, trial) for run in runs]
    for run, one in zip(runs, stretches, strict=True):
        settled = np.clip(np.diff(settled_memory(run.drive_v, trial.thresholds_v), prepend=run.full_v[0]), -gaps, gaps)
        starts = [settled, np.zeros(gaps.size), 0.5 * gaps, -0.5 * gaps] if run.before_v is None else [settled]
        found.append(nearest(one, starts, work.limits(trial), common))
    return stretches, found


def judgements_of(
    work: Work, trial: Trial, others: Sequence[Measured]
) -> tuple[Common, tuple[Judgement, ...], tuple[Judgement, ...]]:
    """Of all recordings, by fits that each had no part in; what they share, and is their own, by a fit to all."""
    stretches, memories = prepared(work, work.runs, trial)
    limits = work.limits(trial)
    common, owns = fitted(stretches, memories, limits)
    found = fits_held_out(stretches, memories, limits)
    first = tuple(_judgement(*one, common, trial) for one in zip(work.runs, stretches, owns, found, strict=True))
    runs, then = [kept(run, len(others)) for run in others], []
    for run, one, rises in zip(runs, *prepared(work, runs, trial, common), strict=True):
        own, held = own_of(one, common, rises, limits), judged(one, common, rises, limits)
        then.append(_judgement(run, one, own, held, common, trial))
    return common, first, tuple(then)


def _judgement(run: Kept, one: Stretch, own: Own, held: Sequence[Held], common: Common, trial: Trial) -> Judgement:
    settled = np.diff(settled_memory(run.drive_v, trial.thresholds_v), prepend=run.full_v[0])
    apart = output(one, common, own) - output(one, common, own._replace(rises=settled))
    known = 0 if run.before_v is not None else known_from(run.drive_v, float(trial.thresholds_v[trial.written - 1]))
    alone = None
    if known is not None and known <= (1 - LEAST_SHOWN) * run.drive_v.size:
        alone = errors_as_written(one, held, trial.written, known)
    return Judgement(
        run.name, run.time_s, run.drive_v, run.position_um, errors_held_out(one, held), alone,
        errors(one, common, own), float(own.terms[0]), float(own.terms[1:].sum()), run.before_v is not None,
        None if known is None else float(run.time_s[known]), float(np.abs(apart - apart[-1]).max()),
    )  # fmt: skip
