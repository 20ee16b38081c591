"""Refined instrumental variables: a plant's modes from a closed loop with coloured noise.

    Σ_k ψ_k(θ) ε_k(θ) = 0,     ε = A_n (x − G(θ) u − x₀),     ψ = A_n ∂G(θ)/∂θ û

(Söderström & Stoica 1983; in closed loop Gilson, Garnier, Young & Van den Hof 2011: the instrument is the noise-free
derivative behind the inverse of the noise model.) û is the part of the input that follows from the reference
(`driven_input`), x₀ the free decay of the modes from before the recording. Noise and plant have no common poles: A_n is
an autoregression of the residuals (Box-Jenkins). If its order is too low, the estimate has more variance, but no bias.

    cov θ = σ² (ΨᵀΦ)⁻¹ ΨᵀΨ (ΦᵀΨ)⁻¹,     Φ = A_n ∂G/∂θ u        (Söderström & Stoica 1989, chapter 8)

If the iteration does not settle, it restarts from the two-stage method: least squares of x on û (Van den Hof &
Schrama 1993).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.signal import oaconvolve

from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.prediction_error import (
    Excitation,
    SampleSelection,
    has_stable_continuous_form,
    minimise_errors,
)
from rtloop.foundation.arrays import Real

NOISE_ORDER = 150
"""Largest order of A_n: light noise near a slow mode takes many samples to identify."""
MOST_STEPS, MOST_HALVINGS = 12, 12
LARGEST_MOVE = 0.3
"""Largest move of a pole in one step, relative to its magnitude."""
LAST_STEP = 0.03
"""Iteration ends at a step below this fraction of the standard deviations."""


@dataclass(frozen=True)
class InstrumentedRecording:
    """Recording with û (samples,), the component of its input that follows from the external excitation."""

    run: Excitation
    driven_input: Real


@dataclass(frozen=True)
class Estimate:
    """Estimate G, and the covariance of `model.pack(noise=False)` without its offset.

    If the iteration did not settle (`is_settled` False), G is its starting model.
    """

    model: Innovations
    covariance: Real
    is_settled: bool


def estimate_plant(
    start: Innovations, data: InstrumentedRecording, whitening: Real, selection: SampleSelection
) -> Estimate | None:
    """Estimate the model near `start` from the samples `selection`, all of which have their past (`past_mask`).

    `whitening` has the taps of the noise filter A_n (`fit_whitening`). If the iteration from `start` does not settle,
    it restarts from the two-stage method's model. None if that model has no stable continuous form; the second
    iteration may be unsettled too.
    """
    if (first_estimate := iterate_estimate(start, data, whitening, selection)).is_settled:
        return first_estimate
    driven, x = whiten(data.driven_input, whitening), whiten(data.run.position_um, whitening)
    two_stage = minimise_errors(start, replace(data.run, input=driven, position_um=x), noise=False, selection=selection)
    return iterate_estimate(two_stage, data, whitening, selection) if has_stable_continuous_form(two_stage) else None


def iterate_estimate(
    first: Innovations, data: InstrumentedRecording, whitening: Real, selection: SampleSelection
) -> Estimate:
    """Iterate from `first` until the instruments ψ and the errors ε, both filtered by `whitening`, are uncorrelated.

    Returns `first`, not settled, if a mode stops decaying or has no continuous form, and if MOST_STEPS steps do not
    suffice.
    """
    u, driven, x = (whiten(signal, whitening) for signal in (data.run.input, data.driven_input, data.run.position_um))
    step, initial_covariance = _newton_step(first, u, driven, x, selection)
    unsettled = Estimate(first, initial_covariance, is_settled=False)
    model = first
    for _ in range(MOST_STEPS):
        model = _bounded_update(model, step)
        if not has_stable_continuous_form(model):
            return unsettled
        step, covariance = _newton_step(model, u, driven, x, selection)
        if np.all(np.abs(step) <= LAST_STEP * np.sqrt(np.maximum(np.diag(covariance), 0.0))):
            return Estimate(model, covariance, is_settled=True)
    return unsettled


def residual_noise(model: Innovations, run: Excitation) -> Real:
    """Return position minus the model's output, free decay and offset in µm, (samples,): the noise of a right model.

    The free decay of the modes from before the recording and the offset are fitted by least squares.
    """
    error = run.position_um - model.simulate_output(run.input)
    decays = _free_decays(model, error.size)
    return error - np.linalg.lstsq(decays.T, error, rcond=None)[0] @ decays


def fit_whitening(noise: Real, most_taps: int = NOISE_ORDER) -> Real:
    """Return the taps of the filter A_n that whitens `noise` (samples,): (NOISE_ORDER + 1,), first 1, zeros behind.

    Its order, up to `most_taps`, has the least Akaike criterion; the taps come from Levinson's recursion.
    """
    spectrum = np.fft.rfft(noise - noise.mean(), 2 * noise.size)
    autocorrelation = np.fft.irfft(np.abs(spectrum) ** 2)[: NOISE_ORDER + 1] / noise.size
    coefficients, power = np.eye(1, NOISE_ORDER + 1)[0], float(autocorrelation[0])
    best_coefficients, least_criterion = coefficients, np.inf
    for order in range(1, most_taps + 1):
        reflection = float(coefficients[:order] @ autocorrelation[order:0:-1]) / power
        coefficients = coefficients - reflection * np.pad(coefficients[order::-1], (0, NOISE_ORDER - order))
        power *= 1 - reflection**2
        if (criterion := noise.size * np.log(power) + 2 * order) < least_criterion:
            best_coefficients, least_criterion = coefficients, criterion
    return best_coefficients


def whiten(signals: Real, whitening: Real) -> Real:
    """Return `signals` (…, samples) filtered by the taps `whitening` from rest.

    The first NOISE_ORDER samples lack their past.
    """
    taps = whitening.reshape((1,) * (signals.ndim - 1) + (-1,))
    return np.asarray(oaconvolve(signals, taps, axes=-1), dtype=float)[..., : signals.shape[-1]]


def past_mask(samples: int) -> npt.NDArray[np.bool_]:
    """Return a mask (samples,): True for the whitened samples that have their past, all but the first NOISE_ORDER."""
    return np.arange(samples) >= NOISE_ORDER


def _free_decays(model: Innovations, samples: int) -> Real:
    """Return a row of ones, then each mode's free decay, real and imaginary part for a pair, (1 + order, samples)."""
    rows = [np.ones(samples)]
    for rate in model.rates:
        decay = np.exp(rate * model.period_s * np.arange(samples))
        rows += [decay.real, decay.imag] if rate.imag else [decay.real]
    return np.array(rows)


def _newton_step(model: Innovations, u: Real, driven: Real, x: Real, selection: SampleSelection) -> tuple[Real, Real]:
    """Return the step (unknowns,) that makes instruments and errors uncorrelated, and its covariance; the offset is not
    among the unknowns.

    `u` is the model's input, `driven` the input that makes the instruments, `x` the position, each (samples,) and
    whitened over its whole length: a cut signal begins with a jump, which rings in the slopes but not in `x`.
    """
    decays, zeros = _free_decays(model, u.size)[:, selection], np.zeros_like(u)
    slopes, instruments = (
        np.vstack([-model.sensitivities(signal, zeros, noise=False)[:-1][:, selection], decays])
        for signal in (u, driven)
    )
    scale = np.linalg.norm(instruments, axis=1)
    scale[scale == 0] = 1.0
    slopes, instruments = slopes / scale[:, None], instruments / scale[:, None]
    residual = (x - replace(model, offset=0.0).simulate_output(u))[selection]
    inverse = np.linalg.pinv(instruments @ slopes.T, rcond=1e-13)
    step = inverse @ (instruments @ residual)
    variance = float(np.sum((residual - step @ slopes) ** 2)) / max(residual.size - step.size - NOISE_ORDER, 1)
    with np.errstate(over="ignore", invalid="ignore"):
        covariance = variance * inverse @ (instruments @ instruments.T) @ inverse.T / np.outer(scale, scale)
    count = model.pack(noise=False).size - 1
    return (step / scale)[:count], covariance[:count, :count]


def _bounded_update(model: Innovations, step: Real) -> Innovations:
    """Return the model after `step` (unknowns without the offset,), halved while it moves a pole by more than
    LARGEST_MOVE of its magnitude or leaves a model without a stable continuous form.

    The last of MOST_HALVINGS tries is returned even if it moves too far or has no such form.
    """
    updated = model
    for halvings in range(MOST_HALVINGS):
        updated = model.unpack(model.pack(noise=False) + np.append(step, 0.0) / 2**halvings, noise=False)
        if has_stable_continuous_form(updated) and np.all(
            np.abs(updated.rates - model.rates) <= LARGEST_MOVE * np.abs(model.rates)
        ):
            break
    return updated
