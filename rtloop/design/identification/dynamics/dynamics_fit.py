"""Result of an identification of linear dynamics: D(s) with D(0) = 1, its modes and how well each is known.

s = log(z)/T,   r_s = r_z s/(z − 1)          inverse of the zero-order hold, exact for each mode
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.inverse_hold import continuous_modal
from rtloop.design.identification.dynamics.residuals import ResidualTests
from rtloop.foundation.arrays import Complex, Real
from rtloop.linear.realisation import modal_realisation
from rtloop.linear.transfer import Transfer
from rtloop.linear.zeros import zeros_and_gain

LARGEST_RELATIVE_STD = 0.1
"""Largest standard deviation, relative to the frequency, of a mode that counts as identified."""
FASTEST_DECAY = 14.0
"""Largest decay of a mode within a tick: e^−14 is about a millionth, which is negligible at the next tick."""
FARTHEST_ZERO = 100.0
"""Largest magnitude of a zero, in multiples of the Nyquist rate π/T. A farther one changes D(s) by less than 1 % at the
Nyquist rate, as a shift by 0.3 % of a tick does: noise makes it, and its sign.
"""


@dataclass(frozen=True)
class Mode:
    """A real pole s, or a pair: frequency |s|/2π, damping −Re s/|s|, and their standard deviations."""

    frequency_hz: float
    frequency_std_hz: float
    damping: float
    damping_std: float
    static_share: float
    """|r/s| of the mode (both of a pair), relative to D(0)."""


@dataclass(frozen=True)
class Candidate:
    """Candidate order: rms one-step-ahead error in µm (on the held-out samples, if there are some), Akaike's criterion
    ln(V) + 2 d/N (V: mean square of this error, d: unknowns, N: samples), and rms output error in µm on other runs
    (NaN: none).
    """

    order: int
    rms_error_um: float
    aic: float
    validation_rms_um: float


@dataclass(frozen=True)
class DynamicsFit:
    """D(s) with D(0) = 1, `static_gain` in position per input, and the evidence: modes, errors, residual tests.

    `rms_error_um` is of the prediction one step ahead. `fit_percent` is 100 (1 − σ(e)/σ(x)): e is the position x minus
    the model's output, which in closed loop includes its free decay.
    """

    transfer: Transfer
    static_gain: float
    static_gain_std: float
    modes: tuple[Mode, ...]
    rms_error_um: float
    fit_percent: float
    tests: ResidualTests
    candidates: tuple[Candidate, ...]
    model: Innovations
    delay_ticks: int
    """Delay in samples beyond the single sample of a held output; `model` acts after it."""
    method: str
    free_motion_s: float = 0.0
    """Duration of the free motion that was left out at the beginning; 0 for a recording from rest (`initial_state`)."""
    free_motion_um: Real | None = None
    """The motion (samples,) that was left out; None from rest."""
    level_correction: float = 0.0
    """Largest correction of a level that the input holds, in the input's unit (`measured_levels`)."""
    left_out_hz: tuple[float, ...] = ()
    """Frequencies |s|/2π of modes that were left out, because the recording does not tell their poles from zeros
    (`uncertain_rates`).
    """


def continuous_transfer(model: Innovations) -> Transfer:
    """Return D(s) of a sampled model, without delay, with D(0) = 1; decays are limited to FASTEST_DECAY per tick, and
    zeros beyond FARTHEST_ZERO are left out.
    """
    discrete = model.discrete()
    rates = np.concatenate([model.rates, model.rates[model.rates.imag != 0].conj()])
    rates, residues = _limit_fast_rates(rates, discrete.residues / model.static_gain, model.period_s)
    modal = continuous_modal(rates, residues, discrete.direct, model.period_s)
    zeros, leading = zeros_and_gain(modal_realisation(modal))
    zeros = zeros[np.abs(zeros) * model.period_s <= FARTHEST_ZERO * np.pi]
    transfer = Transfer.from_zpk(zeros, rates, leading)
    return Transfer.from_zpk(zeros, rates, leading / transfer.dc_gain)


def estimate_modes(model: Innovations, covariance: Real, *, noise: bool) -> tuple[Mode, ...]:
    """Return the modes in rising order of frequency, with standard deviations of frequency and damping.

    `covariance` belongs to `model.pack(noise=noise)`, with or without the offset at its end: `noise` says whether it
    contains the noise gains. A mode that decays faster than FASTEST_DECAY per tick is given as |s| = FASTEST_DECAY per
    tick with damping 1, and infinite standard deviations.
    """
    modes, i = [], 0
    for rate, residue, z_pole in zip(model.rates, model.residues, model.z_poles, strict=True):
        size, width = abs(rate), 2 if rate.imag != 0 else 1
        block = covariance[i : i + width, i : i + width]
        size_gradient = np.array([rate.real, rate.imag][:width]) / size
        damping_gradient = np.array([-(rate.imag**2), rate.real * rate.imag][:width]) / size**3
        share = width * abs(residue / (1 - z_pole) / model.static_gain)
        size_std, damping_std = (
            float(np.sqrt(max(gradient @ block @ gradient, 0.0))) for gradient in (size_gradient, damping_gradient)
        )
        damping = -rate.real / size
        if rate.real * model.period_s < -FASTEST_DECAY:
            size, size_std, damping, damping_std = FASTEST_DECAY / model.period_s, np.inf, 1.0, np.inf
        modes.append(Mode(size / (2 * np.pi), size_std / (2 * np.pi), damping, damping_std, float(share)))
        i += (3 if noise else 2) * width
    return tuple(sorted(modes, key=lambda mode: mode.frequency_hz))


def uncertain_rates(model: Innovations, covariance: Real, *, noise: bool) -> npt.NDArray[np.bool_]:
    """Return which of `model.rates` (m,) have a zero of D(s) within their standard deviation, if it is more than
    LARGEST_RELATIVE_STD of the rate: the recording does not show that such a mode exists. A pole that decays within a
    tick is a part of the delay, and is never among them.

    `covariance` is as for `estimate_modes`.
    """
    zeros, uncertain, i = continuous_transfer(model).zeros, [], 0
    for rate in model.rates:
        width = 2 if rate.imag != 0 else 1
        std = np.sqrt(max(np.trace(covariance[i : i + width, i : i + width]), 0.0))
        is_hidden = zeros.size > 0 and std > max(np.abs(zeros - rate).min(), LARGEST_RELATIVE_STD * abs(rate))
        uncertain.append(is_hidden and rate.real * model.period_s >= -FASTEST_DECAY)
        i += (3 if noise else 2) * width
    return np.array(uncertain, bool)


def static_gain_std(model: Innovations, covariance: Real, *, noise: bool) -> float:
    """Return the standard deviation of `model.static_gain`, from the `covariance` of `model.pack(noise=noise)`, with or
    without the offset at its end.
    """
    slopes: list[float] = []
    for rate, residue, z_pole in zip(model.rates, model.residues, model.z_poles, strict=True):
        by_rate, by_residue = residue * model.period_s * z_pole / (1 - z_pole) ** 2, 1 / (1 - z_pole)
        for slope in (by_rate, by_residue, *([0.0] if noise else [])):
            slopes += [2 * slope.real, -2 * slope.imag] if rate.imag != 0 else [slope.real]
    gradient = np.array(slopes)
    part = covariance[: gradient.size, : gradient.size]
    return float(np.sqrt(max(gradient @ part @ gradient, 0.0)))


def _limit_fast_rates(rates: Complex, residues: Complex, period_s: float) -> tuple[Complex, Complex]:
    """Return rates (n,) in rad/s and residues in z (m, n) with decay limited to FASTEST_DECAY per tick; D(0) is
    preserved.

    A delay by a fraction of a tick makes a pole at z ≈ 0, whose rate in s is so fast that a recording does not show it.
    """
    limited: Complex = rates.copy()
    limited.real = np.maximum(rates.real, -FASTEST_DECAY / period_s)
    gain_ratio = np.expm1(limited * period_s) / np.expm1(rates * period_s)
    return limited, residues * gain_ratio
