"""Whole samples of delay between input and position, beyond the single sample of a held output.

    y_k = Σ a_i y_k−i + Σ b_i u_k−i + constant,     b_1 … b_d = 0      a delay of d samples           ARX

A delay that is left out of a model comes back as real poles near the sampling rate, and a whole sample of it moves the
modes. So models are fitted behind each delay that a long ARX model leaves possible, to the first part of the recording.
Models whose errors follow from the input count only where all do. Models that predict the rest, or after a refit the
whole recording, as well as the best one are compared by their number of poles, then by their error after the refit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.markov import ARX_ORDER, lagged_rows
from rtloop.design.identification.dynamics.prediction_error import (
    LEAST_IMPROVEMENT,
    Excitation,
    fit_models_at_gap,
    judged_rms,
    refine,
    rms_error,
    with_held_out_levels,
)
from rtloop.design.identification.dynamics.residuals import residual_tests
from rtloop.foundation.arrays import Real

MOST_TICKS = 5
LEAST_SHARE = 0.25
"""Least share of the squared changes of the input in each part of a recording, for fitting and for judging."""
SIGNIFICANT_GROWTH = 30.0
"""Growth of the squared error without the first input coefficients, in variances, above which they are significant."""

LARGEST_DOUBT = 10.0
"""Difference of Akaike's criterion beyond which the data do not support a model; Burnham & Anderson 2002, section 2.6.
"""


def delay_input(run: Excitation, ticks: int) -> Excitation:
    """Return the recording with its input `ticks` samples later, 0 before."""
    return replace(run, input=np.concatenate([np.zeros(ticks), run.input[: run.input.size - ticks]]))


class Candidate(NamedTuple):
    """A model of `order` poles behind `ticks` samples of delay.

    `rms_um` is its rms prediction error in the samples that it was not fitted to, `refitted_rms_um` that of all samples
    after a fit to them; `is_independent` says whether its errors in the samples that it was fitted to are independent
    of the past input.
    """

    ticks: int
    order: int
    rms_um: float
    refitted_rms_um: float
    is_independent: bool


def identify_delay(run: Excitation, orders: Sequence[int]) -> int:
    """Return the delay, 0 to MOST_TICKS samples, judged on the held-out samples and on all.

    `orders` are the numbers of poles to try. If no model can be fitted, the longest delay that ARX allows is returned.
    Raises ArithmeticError if the predictor of a refitted model is unstable.
    """
    delays = _candidate_delays(run)
    if len(delays) == 1:
        return delays[0]
    start = held_out_start(run)
    candidates = [
        _judge_candidate(ticks, model, delay_input(run, ticks), start)
        for ticks in delays
        for model in fit_models_at_gap(fitted_part(delay_input(run, ticks), start), orders)
    ]
    return simplest_candidate(candidates, run.input.size).ticks if candidates else delays[-1]


def simplest_candidate(candidates: Sequence[Candidate], samples: int) -> Candidate:
    """Return the candidate of fewest poles among all that predict as well as the best one, within LEAST_IMPROVEMENT:
    the held-out samples, or all `samples` after a refit.

    Among several, the longest delay counts whose Akaike's criterion after the refit is within LARGEST_DOUBT of the
    least: zeros beyond the band seem to make a sample less. A candidate whose errors depend on the input counts only if
    all do.
    """
    eligible = [candidate for candidate in candidates if candidate.is_independent] or candidates
    limit_um = min(candidate.rms_um for candidate in eligible) * (1 + LEAST_IMPROVEMENT)
    refitted_limit_um = min(candidate.refitted_rms_um for candidate in eligible) * (1 + LEAST_IMPROVEMENT)
    predictive = [
        candidate for candidate in eligible
        if candidate.rms_um <= limit_um or candidate.refitted_rms_um <= refitted_limit_um
    ]  # fmt: skip
    fewest_poles = min(candidate.order for candidate in predictive)
    simplest = [candidate for candidate in predictive if candidate.order == fewest_poles]
    doubtful_um = min(candidate.refitted_rms_um for candidate in simplest) * np.exp(LARGEST_DOUBT / (2 * samples))
    return max(
        (candidate for candidate in simplest if candidate.refitted_rms_um <= doubtful_um),
        key=lambda candidate: candidate.ticks,
    )


def _judge_candidate(ticks: int, model: Innovations, run: Excitation, start: int | None) -> Candidate:
    """Return the candidate for a model that was fitted to the samples before `start` (None: to all, which judge it).

    The input of `run` is delayed by `ticks` already. A model with an unstable predictor has infinite errors and counts
    as not independent. Raises ArithmeticError if the predictor of the refitted model is unstable.
    """
    errors = model.errors(run.input, run.position_um)
    if errors is None:
        return Candidate(ticks, model.order, np.inf, np.inf, False)
    tests = residual_tests(run.input[:start], errors[:start], model.pack(noise=True).size)
    levelled = run if start is None else with_held_out_levels(model, run, start)
    refitted = refine(model, levelled)
    refitted_rms_um = np.inf if refitted is None else rms_error(refitted, levelled)
    return Candidate(
        ticks, model.order, judged_rms(model, run, errors, start or 0), refitted_rms_um, tests.is_independent
    )


def fitted_part(run: Excitation, start: int | None) -> Excitation:
    """Return the recording before `start`, on which models are fitted; all of it for None."""
    return replace(run, input=run.input[:start], position_um=run.position_um[:start])


def held_out_start(run: Excitation) -> int | None:
    """Return the first held-out sample; None if no change of the input leaves LEAST_SHARE of all squared changes both
    before it and from it on.

    It is the first change that has at least half of all squared changes before it; if that leaves too few from it on,
    the first change that has at least LEAST_SHARE of them before it.
    """
    changes = np.diff(run.input, prepend=0.0) ** 2
    share_before = (np.cumsum(changes) - changes) / max(float(changes.sum()), 1e-300)
    for share in (0.5, LEAST_SHARE):
        positions = np.flatnonzero((changes > 0) & (share_before >= share))
        if positions.size and share_before[positions[0]] <= 1 - LEAST_SHARE:
            return int(positions[0])
    return None


def _candidate_delays(run: Excitation) -> Sequence[int]:
    """Return the delays in samples, rising from 0 to at most MOST_TICKS, that leave out no significant coefficient of a
    long ARX model. 0 is always among them.
    """
    regressors = np.vstack([*lagged_rows((run.position_um, run.input), ARX_ORDER), np.ones(run.input.size)])
    errors = [
        _squared_error(np.delete(regressors, range(ARX_ORDER, ARX_ORDER + ticks), axis=0), run.position_um)
        for ticks in range(MOST_TICKS + 1)
    ]
    limit = errors[0] * (1 + SIGNIFICANT_GROWTH / run.input.size)
    return [ticks for ticks in range(MOST_TICKS + 1) if errors[ticks] <= limit]


def _squared_error(regressors: Real, position_um: Real) -> float:
    """Return the sum of squared residuals of `position_um` after least squares on `regressors` (k, samples)."""
    solution, *_ = np.linalg.lstsq(regressors.T, position_um, rcond=1e-12)
    return float(np.sum((position_um - solution @ regressors) ** 2))
