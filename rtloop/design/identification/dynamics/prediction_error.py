"""Models of each order that predict a recording best: minimise Σ ε_k² (Ljung 1999, sections 7.2 and 10.2).

Each fit starts from a first guess of the modes: first as if all noise were the sensor's (H = 1), then with H free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from rtloop.design.identification.axis_recording import noise_std
from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.markov import (
    CLEAR_FALL,
    HANKEL_ROWS,
    LIKELY_FALL,
    ModeGuesses,
    fit_residues,
    impulse_response,
)
from rtloop.foundation.arrays import Real

LARGEST_ORDER = 14
LEAST_IMPROVEMENT = 0.01
"""A higher order must lower the rms prediction error by more than this fraction; noise never fits exactly equally."""
LEAST_EXCITATION = 1e-7
"""Singular value of the lagged inputs, relative to the largest, below which a direction is not excited, at any noise.
"""
ENOUGH_POLES = 9
"""An input that can tell so many poles apart has no gap in its spectrum and can tell LARGEST_ORDER apart."""
MOST_LEVELS = 16
"""Most levels of the held-out input that are measured by the position; with more of them, each tells little."""
MOST_EVALUATIONS = 20
SampleSelection = slice | npt.NDArray[np.bool_]
ALL_SAMPLES = slice(None)
HUGE_ERROR, HUGE_SLOPE = 1e6, 1e30
"""Stand in for errors and slopes of trial models that blow up."""


@dataclass(frozen=True)
class Excitation:
    """Input (µm, or V) and position (µm) at equal intervals, each (samples,), from rest."""

    name: str
    input: Real
    position_um: Real
    period_s: float


def fit_models(run: Excitation, orders: Sequence[int]) -> list[Innovations]:
    """Return models of increasing order, from two poles below the last clear gap in the singular values of the impulse
    response, until beyond the last likely gap the last two of five or more models bring no gain.

    A single order is fitted in any case; orders without a stable model are omitted, so that the list may be empty.
    Raises ArithmeticError for a model with an unstable predictor.
    """
    guesses = _mode_guesses(run)
    clear_order, likely_order = (
        guesses.order_at_gap(max(orders), CLEAR_FALL),
        guesses.order_at_gap(max(orders), LIKELY_FALL),
    )
    models: list[Innovations] = []
    errors: list[float] = []
    for order in orders if len(orders) == 1 else [candidate for candidate in orders if candidate >= clear_order - 2]:
        model = _fit_order(guesses, order, run, models)
        if model is None:
            continue
        models.append(model)
        errors.append(rms_error(model, run))
        if order > likely_order and len(errors) > 4 and min(errors[-2:]) > (1 - LEAST_IMPROVEMENT) * min(errors[:-2]):
            break
    return models


def fit_models_at_gap(run: Excitation, orders: Sequence[int]) -> list[Innovations]:
    """Return models of the order within `orders` that the impulse response shows, and of one pole more, because a fast
    real pole hides below the gap; a single order is fitted in any case. [] if none is stable.
    """
    guesses = _mode_guesses(run)
    gap_order = guesses.order_at_gap(max(orders), LIKELY_FALL) if len(orders) > 1 else orders[0]
    models: list[Innovations] = []
    for order in [order for order in (gap_order, gap_order + 1) if order in orders]:
        if (model := _fit_order(guesses, order, run, models)) is not None:
            models.append(model)
    return models


def _fit_order(guesses: ModeGuesses, order: int, run: Excitation, smaller: Sequence[Innovations]) -> Innovations | None:
    """Return the fitted model of `order` poles, from the guess or else from the last of `smaller` and a fast pole.

    None if there is no guess and `smaller` does not end with order − 1, or if a fitted mode does not decay or has no
    continuous form.
    """
    start = guesses.initial_model(order)
    if start is None and smaller and smaller[-1].order == order - 1:
        start = _add_fast_pole(smaller[-1])
    return start and refine(fit_residues(start, run.input, run.position_um), run)


def _mode_guesses(run: Excitation) -> ModeGuesses:
    """Return the guesser of modes from the recording's impulse response, for models of any order."""
    return ModeGuesses(impulse_response(run.input, run.position_um, 2 * HANKEL_ROWS + 2), run.period_s)


def _add_fast_pole(model: Innovations) -> Innovations:
    """Return the model with one more real pole, at −1/T in s, of residue and noise gain 0."""
    return Innovations(
        model.period_s,
        np.append(model.rates, -1 / model.period_s),
        np.append(model.residues, 0.0),
        np.append(model.noise_gains, 0.0),
        model.offset,
    )


def refine(model: Innovations, run: Excitation) -> Innovations | None:
    """Return the model of least squared prediction errors nearby, fitted first with its noise gains as they are, then
    with these too.

    None if a mode does not decay or has no continuous form.
    """
    for noise in (False, True):
        model = minimise_errors(model, run, noise=noise)
    return model if has_stable_continuous_form(model) else None


def minimise_errors(
    model: Innovations, run: Excitation, *, noise: bool, selection: SampleSelection = ALL_SAMPLES
) -> Innovations:
    """Return the model of least squared prediction errors over the samples `selection`, downhill from `model`.

    `noise` fits the noise gains too; they stay otherwise. The search ends after MOST_EVALUATIONS evaluations, converged
    or not.
    """
    return minimise_with_levels(model, run, np.zeros((0, run.input.size)), noise=noise, selection=selection)[0]


def minimise_with_levels(
    model: Innovations, run: Excitation, steps: Real, *, noise: bool, selection: SampleSelection = ALL_SAMPLES
) -> tuple[Innovations, Real]:
    """Return the model of `minimise_errors`, and the sizes (levels,) of unit steps (levels, samples) that are added to
    the input.
    """
    count = model.pack(noise=noise).size

    def errors(values: Real) -> Real:
        """Return the prediction errors in µm (samples,); HUGE_ERROR for a model that does not decay or predicts
        unstably.
        """
        trial, u = model.unpack(values[:count], noise=noise), run.input + values[count:] @ steps
        if np.any(trial.rates.real >= 0) or (solution := trial.errors(u, run.position_um)) is None:
            return np.full(run.input.size, HUGE_ERROR)
        return np.clip(np.nan_to_num(solution, nan=HUGE_ERROR), -HUGE_ERROR, HUGE_ERROR)

    def jacobian(values: Real) -> Real:
        """Return the derivatives of the errors by the unknowns, (samples, unknowns), limited to ±HUGE_SLOPE."""
        trial, u = model.unpack(values[:count], noise=noise), run.input + values[count:] @ steps
        by_model = trial.sensitivities(u, errors(values), noise=noise)
        solution = np.vstack([by_model, -_step_responses(trial, steps)]).T
        return np.clip(np.nan_to_num(solution, nan=HUGE_SLOPE), -HUGE_SLOPE, HUGE_SLOPE)

    settings: dict[str, Any] = {
        "x_scale": "jac",
        "xtol": 1e-8,
        "ftol": 1e-8,
        "gtol": 1e-15,
        "max_nfev": MOST_EVALUATIONS,
    }
    with np.errstate(over="ignore", invalid="ignore"):
        selected_jacobian: Any = lambda values: jacobian(values)[selection]
        solution = least_squares(
            lambda values: errors(values)[selection],
            np.append(model.pack(noise=noise), np.zeros(len(steps))),
            selected_jacobian,
            **settings,
        )
    return model.unpack(solution.x[:count], noise=noise), solution.x[count:]


def _step_responses(model: Innovations, steps: Real) -> Real:
    """Return the effect of steps (levels, samples) of the input on the position, whitened as the prediction errors
    are, in the same shape.
    """
    columns = [model.simulate_output(step) - model.offset for step in steps]
    return model.whiten(np.array(columns).reshape(steps.shape), model.predictor_poles())


def has_stable_continuous_form(model: Innovations) -> bool:
    """Return whether Re s < 0 and |Im s| < π/T hold for all rates s of the model, so that log(z) recovers them."""
    is_below_nyquist = np.abs(model.rates.imag) < np.pi / model.period_s
    return bool(np.all((model.rates.real < 0) & is_below_nyquist))


def rms_error(model: Innovations, run: Excitation, start: int = 0) -> float:
    """Return the rms one-step-ahead error in µm of a fitted model, from sample `start` on (`judged_rms`).

    Raises ArithmeticError for an unstable predictor.
    """
    return judged_rms(model, run, prediction_errors(model, run), start)


def judged_rms(model: Innovations, run: Excitation, errors: Real, start: int) -> float:
    """Return the rms of prediction errors (samples,) from sample `start` on, without what follows from wrong levels of
    the input there (`_held_out_levels`).
    """
    judged = errors[start:]
    if start:
        _, responses, sizes = _held_out_levels(model, run, errors, start)
        judged = judged - responses @ sizes
    return float(np.sqrt(np.mean(judged**2)))


def with_held_out_levels(model: Innovations, run: Excitation, start: int) -> Excitation:
    """Return the recording with the levels of its input from sample `start` on as `model` and the position show them.

    Raises ArithmeticError for an unstable predictor.
    """
    steps, _, sizes = _held_out_levels(model, run, prediction_errors(model, run), start)
    return replace(run, input=np.append(run.input[:start], run.input[start:] + sizes @ steps))


def _held_out_levels(model: Innovations, run: Excitation, errors: Real, start: int) -> tuple[Real, Real, Real]:
    """Return unit steps of the input from `start` on (levels, samples), their effect on the prediction errors (samples,
    levels), and their sizes (levels,) by least squares.

    The model of the hysteresis errs by a constant at each level, which no order of D(s) can predict. An input of more
    than MOST_LEVELS levels has one such error, of its first change.
    """
    changes = np.flatnonzero(np.diff(run.input[start - 1 :]))
    changes = changes if changes.size <= MOST_LEVELS else changes[:1]
    steps = (np.arange(errors.size - start) >= changes[:, None]).astype(float)
    responses = _step_responses(model, steps).T
    sizes, *_ = np.linalg.lstsq(responses, errors[start:], rcond=1e-12)
    return steps, responses, np.asarray(sizes, np.float64)


def prediction_errors(model: Innovations, run: Excitation) -> Real:
    """Return the one-step-ahead errors in µm (samples,). Raises ArithmeticError for an unstable predictor."""
    errors = model.errors(run.input, run.position_um)
    if errors is None:
        raise ArithmeticError(
            f"{run.name}: the predictor of the model of order {model.order} is unstable; use another order"
        )
    return errors


def excited_order(run: Excitation) -> int:
    """Return the number of poles that the input can tell apart: half the directions of its lagged copies (Ljung 1999,
    section 13.2); from ENOUGH_POLES on, LARGEST_ORDER.

    A direction counts where its effect on the position, with the gain that the spans suggest, stands out of the noise.
    """
    lags = 2 * ENOUGH_POLES
    lagged = np.array([np.concatenate([np.zeros(i), run.input[: run.input.size - i]]) for i in range(lags)])
    sizes = np.linalg.svd(lagged @ lagged.T, compute_uv=False)
    gain = np.ptp(run.position_um) / max(np.ptp(run.input), 1e-300)
    noise = noise_std(run.position_um) / max(gain, 1e-300) * np.sqrt(lags)
    poles = int((sizes > max(LEAST_EXCITATION**2 * sizes[0], noise**2)).sum()) // 2
    return poles if poles < ENOUGH_POLES else max(poles, LARGEST_ORDER)
