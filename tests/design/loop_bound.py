"""Least standard deviations of modes identified from a loop's recording: the Cramér-Rao bound, by numpy and scipy.

    cov θ ≥ (Σ ψ ψᵀ)⁻¹,     ψ = H⁻¹ ∂G/∂θ u_r / σ,     Φ_n = σ² |H|²

u_r is the command without its noise. No unbiased estimate that does not know the noise's spectrum does better, inside a
loop or outside: the recording is Gaussian, r moves its mean by S C G' r and its spectrum may be any. So it is the bound
of the open loop moved by u_r too (Forssell & Ljung 1999, section 5). Order and delay are known; λ and r of each mode in
G = Σ r/(z − λ), and an offset, are not.
"""

from __future__ import annotations

import numpy as np

from tests.design.coloured_loops import DRIFT, PERIOD_S, SENSOR_UM, VIBRATION, TrueLoop, lfilter, noise_denominators


def bounds_percent(loop: TrueLoop, command_um: np.ndarray, near_hz: float, rms_um: float) -> np.ndarray:
    """Return (modes, 2): least standard deviations of frequency and damping, in percent of the true values.

    `command_um` is u_r. The noise is `coloured_noise` with the same `near_hz` and `rms_um`.
    """
    delayed_um = np.concatenate([np.zeros(loop.delay_ticks), command_um[: command_um.size - loop.delay_ticks]])
    rows = [np.ones(delayed_um.size)]
    for hz, damping, share in loop.modes:
        pole_s = 2 * np.pi * hz * (-damping + 1j * np.sqrt(1 - damping**2))
        pole_z = np.exp(pole_s * PERIOD_S)
        residue = share * abs(pole_s) ** 2 / (2j * pole_s.imag) * (pole_z - 1) / pole_s
        mode = lfilter([0, 1], [1, -pole_z], delayed_um.astype(complex))
        for part in (PERIOD_S * pole_z * residue * lfilter([0, 1], [1, -pole_z], mode), mode):
            rows += [2 * np.real(part), -2 * np.imag(part)]
    numerator, denominator, sigma = noise_factor(near_hz, rms_um)
    whitened = lfilter(denominator, numerator, np.array(rows)) / sigma
    sizes = np.linalg.norm(whitened, axis=1)
    covariance = np.linalg.inv((whitened / sizes[:, None]) @ (whitened / sizes[:, None]).T) / np.outer(sizes, sizes)
    deviations_percent = []
    for i, (hz, damping, _) in enumerate(loop.modes):
        pole_covariance = covariance[4 * i + 1 : 4 * i + 3, 4 * i + 1 : 4 * i + 3]
        omega, real, imag = 2 * np.pi * hz, -damping, np.sqrt(1 - damping**2)
        slopes = np.array([[real, imag], np.array([-(imag**2), real * imag]) / damping]) / omega
        deviations_percent.append(100 * np.sqrt(np.diag(slopes @ pole_covariance @ slopes.T)))
    return np.array(deviations_percent)


def noise_factor(near_hz: float, rms_um: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return H (numerator, denominator in 1/z) and σ of `coloured_noise`: the spectral factor of its parts' sum."""
    vibration, drift = noise_denominators(near_hz)
    poles = np.convolve(vibration, drift)
    parts = [
        (SENSOR_UM, poles),
        (VIBRATION * rms_um / _output_std(vibration), drift),
        (DRIFT * rms_um / _output_std(drift), vibration),
    ]
    spectra = [np.convolve(size * polynomial, size * polynomial[::-1]) for size, polynomial in parts]
    spectrum = np.sum([np.pad(part, (poles.size - 1 - part.size // 2,)) for part in spectra], axis=0)
    roots = np.roots(spectrum)
    numerator = np.poly(roots[np.abs(roots) < 1]).real
    return numerator, poles, float(np.sqrt(spectrum.sum()) / numerator.sum())


def _output_std(poles: np.ndarray) -> float:
    """Return the standard deviation of white noise of variance 1 filtered by 1/poles."""
    impulse = np.zeros(100_000)
    impulse[0] = 1.0
    return float(np.linalg.norm(lfilter([1.0], poles, impulse)))
