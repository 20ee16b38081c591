"""A plant's modes from a closed loop by refined instrumental variables, whatever colours the noise.

    Σ_k ψ_k(θ) ε_k(θ) = 0,     ε = A_n (x − G(θ) u − x₀),     ψ = A_n ∂G(θ)/∂θ û

(Söderström & Stoica 1983; in closed loop Gilson, Garnier, Young & Van den Hof 2011: the instrument is the noise-free
derivative behind the inverse of the noise model.) û is the part of the input that follows from the reference
(`outside`), x₀ what the modes still ring of before the recording. Noise and plant have no poles in common: A_n is an
autoregression of what is left (Box-Jenkins), and where it is too short for the truth, the estimate has more variance
and no bias.

    cov θ = σ² (ΨᵀΦ)⁻¹ ΨᵀΨ (ΦᵀΨ)⁻¹,     Φ = A_n ∂G/∂θ u        (Söderström & Stoica 1983, eq 4.13)

It begins with the two-stage method: least squares of x on û (Van den Hof & Schrama 1993).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve
from scipy.signal import lfilter

from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.markov import ARX_ORDER, lagged
from rtloop.design.identification.dynamics.prediction_error import ALL, Excitation, Kept, descended, has_counterpart
from rtloop.hil.modal import Real

STEPS, HALVINGS = 40, 12
FURTHEST = 0.3
"""Of its own size: so far a pole moves at once."""
NEAR = 0.03
"""A step by less than this part of the standard deviations is the last."""


@dataclass(frozen=True)
class Instrumented:
    """A recording and the part û (samples,) of its input that follows from outside."""

    run: Excitation
    driven: Real


@dataclass(frozen=True)
class Estimate:
    """G and the covariance of `model.pack(noise=False)` without its offset; where the steps towards Σ ψ ε = 0 did not
    settle, G is that of the two-stage method."""

    model: Innovations
    covariance: Real
    settled: bool


def estimated(start: Innovations, data: Instrumented, whitening: Real, kept: Kept = ALL) -> Estimate | None:
    """The model next to `start` by the samples `kept` of the whitened ones; None where there is none that decays."""
    u, driven, x = (whitened(one, whitening) for one in (data.run.input, data.driven, data.run.position_um))
    run = replace(data.run, input=driven, position_um=x)
    first = descended(start, run, noise=False, kept=kept)
    if not _decays(first):
        return None
    step, spread = _step(first, u, driven, x, kept)
    without = Estimate(first, spread, settled=False)
    model = first
    for _ in range(STEPS):
        model = _moved(model, step)
        if not _decays(model):
            return without
        step, covariance = _step(model, u, driven, x, kept)
        if np.all(np.abs(step) <= NEAR * np.sqrt(np.diag(covariance))):
            return Estimate(model, covariance, settled=True)
    return without


def left_by(model: Innovations, run: Excitation) -> Real:
    """x − G u − x₀ (samples,): noise, where the model is right. x₀, and an offset, are those that leave least."""
    left = run.position_um - model.output(run.input)
    ringing = _ringing(model, left.size)
    return left - np.linalg.lstsq(ringing.T, left, rcond=None)[0] @ ringing


def whitening_of(noise: Real) -> Real:
    """A_n (ARX_ORDER + 1,) by least squares."""
    past = lagged((noise,), ARX_ORDER)[:, ARX_ORDER:]
    normal = past @ past.T
    normal[np.diag_indices_from(normal)] *= 1 + 1e-12
    return np.concatenate([[1.0], -solve(normal, past @ noise[ARX_ORDER:], assume_a="pos")])


def whitened(signal: Real, whitening: Real) -> Real:
    """A_n applied, from the first sample on that has its past: (samples − ARX_ORDER,)."""
    return np.asarray(lfilter(whitening, 1.0, signal), dtype=float)[whitening.size - 1 :]


def _ringing(model: Innovations, samples: int) -> Real:
    """A constant, and the free decays of all modes."""
    rows = [np.ones(samples)]
    for rate in model.rates:
        decay = np.exp(rate * model.period_s * np.arange(samples))
        rows += [decay.real, decay.imag] if rate.imag else [decay.real]
    return np.array(rows)


def _step(model: Innovations, u: Real, driven: Real, x: Real, kept: Kept) -> tuple[Real, Real]:
    """Towards Σ ψ ε = 0, without the offset, and the covariance of where it leads; all signals are whitened."""
    ringing, nothing = _ringing(model, u.size)[:, kept], np.zeros_like(u)
    slopes, instruments = (
        np.vstack([-model.sensitivities(one, nothing, noise=False)[:-1][:, kept], ringing]) for one in (u, driven)
    )
    scale = np.linalg.norm(instruments, axis=1)
    scale[scale == 0] = 1.0
    slopes, instruments = slopes / scale[:, None], instruments / scale[:, None]
    left = (x - replace(model, offset=0.0).output(u))[kept]
    inverse = np.linalg.pinv(instruments @ slopes.T, rcond=1e-13)
    step = inverse @ (instruments @ left)
    variance = float(np.sum((left - step @ slopes) ** 2)) / max(left.size - step.size - ARX_ORDER, 1)
    covariance = variance * inverse @ (instruments @ instruments.T) @ inverse.T / np.outer(scale, scale)
    count = model.pack(noise=False).size - 1
    return (step / scale)[:count], covariance[:count, :count]


def _decays(model: Innovations) -> bool:
    return bool(np.all(model.rates.real < 0)) and has_counterpart(model)


def _moved(model: Innovations, step: Real) -> Innovations:
    """By `step`, or by a part of it where all of it moves a pole beyond FURTHEST, or to where it does not decay."""
    tried = model
    for halvings in range(HALVINGS):
        tried = model.unpack(model.pack(noise=False) + np.append(step, 0.0) / 2**halvings, noise=False)
        if _decays(tried) and np.all(np.abs(tried.rates - model.rates) <= FURTHEST * np.abs(model.rates)):
            break
    return tried
