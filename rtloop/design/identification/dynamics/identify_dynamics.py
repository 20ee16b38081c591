"""Linear dynamics D(s) from recorded input and output: ARMAX by prediction errors, normalised to D(0) = 1.

    minimise Σ ε_k²     over the modes of G and H (`innovations`; Ljung 1999, sections 7.2 and 10.2)

A first guess of each order comes from the modes of a long ARX model. Only the product of hysteresis gain and D(0) can
be told from a recording: G(1) is divided out and reported as `static_gain`, which belongs to the hysteresis.

Poles beyond half the sampling rate cannot be seen: each appears, if at all, at its alias below it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Literal

import numpy as np

from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.identification.dynamics.dynamics_fit import (
    Candidate,
    DynamicsFit,
    continuous_transfer,
    estimate_modes,
    static_gain_std,
    uncertain_rates,
)
from rtloop.design.identification.dynamics.estimate_covariance import estimate_covariance
from rtloop.design.identification.dynamics.identify_delay import (
    delay_input,
    fitted_part,
    held_out_start,
    identify_delay,
)
from rtloop.design.identification.dynamics.initial_state import free_motion
from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.markov import fit_residues
from rtloop.design.identification.dynamics.measured_levels import correct_levels, fit_levels
from rtloop.design.identification.dynamics.prediction_error import (
    LARGEST_ORDER,
    LEAST_IMPROVEMENT,
    Excitation,
    excited_order,
    fit_models,
    prediction_errors,
    refine,
    rms_error,
    with_held_out_levels,
)
from rtloop.design.identification.dynamics.residuals import LARGEST_CROSS_RATIO, residual_tests

Criterion = Literal["aic", "held-out", "validation"]
METHOD = "prediction errors (ARMAX), open loop"
MOST_REPETITIONS = 3
"""Most further identifications of a recording, each without the free motion found before."""
LARGEST_GROWTH = 1.5
"""Largest growth of the rms prediction error by leaving out an uncertain mode."""
LEAST_CORRECTION = 0.1
"""Least correction of a level, in µm of the position, relative to the rms prediction error; a smaller one hides and
makes no mode.
"""
LEAST_EXCITED_POLES = 4
"""Fewest poles that the input must excite if the order is searched."""


def identify_dynamics(
    run: Excitation,
    order: int | None = None,
    largest_order: int = LARGEST_ORDER,
    criterion: Criterion = "held-out",
    validation: Sequence[Excitation] = (),
    delay_ticks: int | None = None,
) -> DynamicsFit:
    """Identify a model of `order` poles behind `delay_ticks` samples of delay; each that is None is estimated, the
    order by `criterion` up to `largest_order`.

    "held-out" judges by the prediction of the second part of the run, or as "aic" if the input changes too little for
    two parts (`held_out_start`); "aic" by the run itself, which takes slow errors of the hysteresis model for modes;
    "validation" by the free-running output error on `validation`. Free motion of a run that does not begin at rest is
    estimated and left out. Raises UnsuitableData if the input excites too few poles, if no model is stable, if every
    model has a time constant longer than the run; ValueError for "validation"
    without other recordings; ArithmeticError for a model with an unstable predictor.
    """
    left_out_um, duration_s, repetitions = np.zeros_like(run.position_um), 0.0, 0
    while True:
        rest_run = replace(run, position_um=run.position_um - left_out_um)
        fit, recording = _identify_with_levels(rest_run, order, largest_order, criterion, validation, delay_ticks)
        motion = free_motion(fit.model, recording) if repetitions < MOST_REPETITIONS else None
        if motion is None:
            return replace(fit, free_motion_s=duration_s, free_motion_um=left_out_um) if duration_s else fit
        repetitions += 1
        left_out_um, duration_s = left_out_um + motion.position_um, max(duration_s, motion.duration_s)


def _identify_with_levels(
    run: Excitation,
    order: int | None,
    largest_order: int,
    criterion: Criterion,
    validation: Sequence[Excitation],
    delay_ticks: int | None,
) -> tuple[DynamicsFit, Excitation]:
    """Identify a model as `identify_dynamics`, of a run from rest. Returns also the run that the model was fitted to.

    The input of that run is delayed, and the levels that the input holds are corrected: by the settled position
    (`correct_levels`), or else by first models (`fit_levels`), where a second one then predicts as well. Its position
    is relative to the first one. Raises as `identify_dynamics`.
    """
    settings = (order, largest_order, criterion, validation, delay_ticks)
    first_run = replace(run, position_um=run.position_um - run.position_um[0])
    corrected_run, correction = correct_levels(first_run)
    fit, recording, models = _identify_from_rest(corrected_run, *settings)
    if corrected_run is not first_run:
        return replace(fit, level_correction=correction), recording
    fitted_run, correction = fit_levels(first_run, models, fit.delay_ticks)
    if correction * abs(fit.static_gain) <= LEAST_CORRECTION * fit.rms_error_um:
        return fit, recording
    with suppress(UnsuitableData, ArithmeticError):
        second_fit, second_recording, _ = _identify_from_rest(fitted_run, *settings)
        if second_fit.rms_error_um <= (1 + LEAST_IMPROVEMENT) * fit.rms_error_um:
            return replace(second_fit, level_correction=correction), second_recording
    return fit, recording


def _identify_from_rest(
    run: Excitation,
    order: int | None,
    largest_order: int,
    criterion: Criterion,
    validation: Sequence[Excitation],
    delay_ticks: int | None,
) -> tuple[DynamicsFit, Excitation, list[Innovations]]:
    """Identify a model as `identify_dynamics`, of a run from rest whose position begins at 0. Returns also the run that
    the model was fitted to, whose input is delayed, and all models that were compared. Raises as `identify_dynamics`.
    """
    if criterion == "validation" and not validation:
        raise ValueError("criterion 'validation' needs another recording for the validation; give a further RUN")
    excited_poles = excited_order(run)
    needed_poles = order or LEAST_EXCITED_POLES
    if excited_poles < needed_poles:
        raise UnsuitableData(
            f"{run.name}: too little excitation: this input identifies at most {excited_poles} poles; the model needs "
            f"{needed_poles} or more. Use a step, or a chirp over all frequencies of interest"
        )
    orders = [order] if order else range(1, min(largest_order, excited_poles) + 1)
    if delay_ticks is None:
        delay_ticks = identify_delay(run, orders)
    recording, validation = (
        delay_input(run, delay_ticks),
        [delay_input(other_run, delay_ticks) for other_run in validation],
    )
    start = held_out_start(recording) if criterion == "held-out" else None
    models = fit_models(fitted_part(recording, start), orders)
    if not models:
        raise UnsuitableData(
            f"{run.name}: no stable model of order {', '.join(map(str, orders))} found; use another order"
        )
    models = _require_settled(models, recording)
    candidates = [_score_model(model, recording, start, validation) for model in models]
    score: Callable[[Candidate], float] = lambda c: c.validation_rms_um if criterion == "validation" else c.rms_error_um
    eligible = [candidates[i] for i in _independent(models, fitted_part(recording, start))]
    chosen = _choose_candidate(eligible, score, by_aic=criterion != "validation" and start is None)
    model = models[candidates.index(chosen)]
    if start is not None:
        recording = with_held_out_levels(model, recording, start)
        if (refitted := refine(model, recording)) and _has_settled(refitted, recording):
            model = refitted
    return _build_fit(model, recording, tuple(candidates), delay_ticks, prune=order is None), recording, models


def _require_settled(models: Sequence[Innovations], run: Excitation) -> list[Innovations]:
    """Return the models for which `_has_settled` is true. Raises UnsuitableData if there is none.

    A slower pole models drift, creep or an error of the hysteresis model, and may hold most of D(0).
    """
    settled = [model for model in models if _has_settled(model, run)]
    if not settled:
        slowest_s = max(1 / max(np.abs(model.rates).min(), 1e-300) for model in models)
        duration_s = run.input.size * run.period_s
        raise UnsuitableData(
            f"{run.name}: the position drifts or creeps: every model has a time constant longer than the recording, "
            f"for example {slowest_s:.3g} s; the recording has {duration_s:.3g} s. Record longer, or let the stage "
            "settle before the recording"
        )
    return settled


def _has_settled(model: Innovations, run: Excitation) -> bool:
    """Whether 1/|s| of each pole s, for a pair the inverse of its natural frequency, is at most the run's duration."""
    return float(np.abs(model.rates).min()) * run.input.size * run.period_s >= 1


def _score_model(model: Innovations, run: Excitation, start: int | None, validation: Sequence[Excitation]) -> Candidate:
    """Return a model's order, rms prediction error in µm from sample `start` on (None: of all), AIC, and rms output
    error in µm on `validation` (NaN without). Raises ArithmeticError for an unstable predictor.
    """
    rms = rms_error(model, run, start or 0)
    unknowns = model.pack(noise=True).size
    return Candidate(
        model.order, rms, 2 * np.log(rms) + 2 * unknowns / run.input.size, _validation_rms(model, validation)
    )


def _validation_rms(model: Innovations, runs: Sequence[Excitation]) -> float:
    """Return the rms error in µm of the free-running output over all `runs`, with an offset for each run; NaN without
    runs.
    """
    errors = [run.position_um - model.simulate_output(run.input) for run in runs]
    return float(np.sqrt(np.mean(np.concatenate([part - part.mean() for part in errors]) ** 2))) if errors else np.nan


def _independent(models: Sequence[Innovations], run: Excitation) -> Sequence[int]:
    """Return the indices of the models whose errors in `run` do not follow from the input beyond LARGEST_CROSS_RATIO of
    the bound; of all models, if there is none.
    """
    unknowns = [model.pack(noise=True).size for model in models]
    tests = [
        residual_tests(run.input, prediction_errors(model, run), count)
        for model, count in zip(models, unknowns, strict=True)
    ]
    independent = [i for i, test in enumerate(tests) if test.cross_ratio <= LARGEST_CROSS_RATIO]
    return independent or range(len(models))


def _choose_candidate(
    candidates: Sequence[Candidate], score: Callable[[Candidate], float], *, by_aic: bool
) -> Candidate:
    """Return the smallest order whose score is within LEAST_IMPROVEMENT of the least score and, if `by_aic`, whose AIC
    is the least among all orders up to it; without such an order, the one of the least score.

    `candidates` are in rising order.
    """
    limit = min(map(score, candidates)) * (1 + LEAST_IMPROVEMENT)
    for i, candidate in enumerate(candidates):
        if score(candidate) <= limit and (not by_aic or candidate.aic <= min(c.aic for c in candidates[: i + 1])):
            return candidate
    return min(candidates, key=score)


def _build_fit(
    model: Innovations, run: Excitation, candidates: tuple[Candidate, ...], delay_ticks: int, *, prune: bool
) -> DynamicsFit:
    """Return the result for the chosen model, with residual tests and standard deviations from the whole run.

    `candidates` are all models compared. The input of `run` is delayed by `delay_ticks` already. Errors that follow
    from the input beyond LARGEST_CROSS_RATIO of the bound widen the deviations by that ratio. `prune` leaves out modes
    whose pole the recording does not tell from a zero (`uncertain_rates`), one by one, unless the errors would then
    follow from the input. Raises ArithmeticError for an unstable predictor.
    """
    errors = prediction_errors(model, run)
    output_error_um = run.position_um - model.simulate_output(run.input)
    tests = residual_tests(run.input, errors, model.pack(noise=True).size)
    covariance = estimate_covariance(model, run, errors, white=tests.is_white)
    if tests.cross_ratio > LARGEST_CROSS_RATIO:
        covariance = covariance * tests.cross_ratio**2
    if prune and model.rates.size > 1:
        for mode in np.flatnonzero(uncertain_rates(model, covariance, noise=True)):
            smaller = _without_mode(model, int(mode), run)
            if smaller is not None:
                fit = _build_fit(smaller, run, candidates, delay_ticks, prune=True)
                if tests.is_independent and not fit.tests.is_independent:
                    continue
                left_out_hz = float(abs(model.rates[mode])) / (2 * np.pi)
                return replace(fit, left_out_hz=(left_out_hz, *fit.left_out_hz))
    return DynamicsFit(
        continuous_transfer(model),
        model.static_gain,
        static_gain_std(model, covariance, noise=True),
        estimate_modes(model, covariance, noise=True),
        float(np.sqrt(np.mean(errors**2))),
        100 * (1 - float(np.std(output_error_um) / np.std(run.position_um))),
        tests,
        candidates,
        model,
        delay_ticks,
        METHOD,
    )


def _without_mode(model: Innovations, mode: int, run: Excitation) -> Innovations | None:
    """Return the model without one of its modes, fitted to `run`.

    None if it is unstable, or if its prediction error is more than LARGEST_GROWTH times that of `model`.
    """
    rates, residues, gains = (np.delete(part, mode) for part in (model.rates, model.residues, model.noise_gains))
    smaller = Innovations(model.period_s, rates, residues, gains, model.offset)
    if smaller.errors(run.input, run.position_um) is None:
        smaller = replace(smaller, noise_gains=np.zeros_like(gains))
    fitted = refine(fit_residues(smaller, run.input, run.position_um), run)
    if fitted is None or fitted.errors(run.input, run.position_um) is None:
        return None
    return fitted if rms_error(fitted, run) <= LARGEST_GROWTH * rms_error(model, run) else None
