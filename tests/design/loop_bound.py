"""Least standard deviations of modes identified from a loop's recording: the Cramér-Rao bound, by numpy and scipy.

    cov θ ≥ (Σ ψ ψᵀ)⁻¹,     ψ = H⁻¹ ∂G/∂θ u_r / σ,     Φ_n = σ² |H|²

u_r is the command without its noise. No unbiased estimate that does not know the noise's spectrum does better, inside a
loop or outside: the recording is Gaussian, r moves its mean by S C G' r and its spectrum may be any. So it is the bound
of the open loop moved by u_r too (Forssell & Ljung 1999, section 5). Order and delay are known; λ and r of each mode in
G = Σ r/(z − λ), and an offset, are not.
"""

from __future__ import annotations

import numpy as np

from tests.design.coloured_loops import DRIFT, PERIOD_S, SENSOR_UM, VIBRATION, TrueLoop, filtered, noise_denominators


def bounds_percent(loop: TrueLoop, driven_um: np.ndarray, near_hz: float, rms_um: float) -> np.ndarray:
    """Return (modes, 2): least standard deviations of frequency and damping, in percent of the true values."""
    driven = np.concatenate([np.zeros(loop.delay_ticks), driven_um[: driven_um.size - loop.delay_ticks]])
    rows = [np.ones(driven.size)]
    for hz, damping, share in loop.modes:
        rate = 2 * np.pi * hz * (-damping + 1j * np.sqrt(1 - damping**2))
        image = np.exp(rate * PERIOD_S)
        residue = share * abs(rate) ** 2 / (2j * rate.imag) * (image - 1) / rate
        mode = filtered([0, 1], [1, -image], driven.astype(complex))
        for part in (PERIOD_S * image * residue * filtered([0, 1], [1, -image], mode), mode):
            rows += [2 * np.real(part), -2 * np.imag(part)]
    top, bottom, sigma = noise_factor(near_hz, rms_um)
    whitened = filtered(bottom, top, np.array(rows)) / sigma
    sizes = np.linalg.norm(whitened, axis=1)
    covariance = np.linalg.inv((whitened / sizes[:, None]) @ (whitened / sizes[:, None]).T) / np.outer(sizes, sizes)
    deviations_percent = []
    for i, (hz, damping, _) in enumerate(loop.modes):
        part = covariance[4 * i + 1 : 4 * i + 3, 4 * i + 1 : 4 * i + 3]
        omega, real, imag = 2 * np.pi * hz, -damping, np.sqrt(1 - damping**2)
        slopes = np.array([[real, imag], np.array([-(imag**2), real * imag]) / damping]) / omega
        deviations_percent.append(100 * np.sqrt(np.diag(slopes @ part @ slopes.T)))
    return np.array(deviations_percent)


def noise_factor(near_hz: float, rms_um: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return H (numerator, denominator in 1/z) and σ of the noise `coloured`: the spectral factor of its parts' sum."""
    vibration, drift = noise_denominators(near_hz)
    poles = np.convolve(vibration, drift)
    parts = [
        (SENSOR_UM, poles),
        (VIBRATION * rms_um / _output_std(vibration), drift),
        (DRIFT * rms_um / _output_std(drift), vibration),
    ]
    spectra = [np.convolve(size * numerator, size * numerator[::-1]) for size, numerator in parts]
    spectrum = np.sum([np.pad(part, (poles.size - 1 - part.size // 2,)) for part in spectra], axis=0)
    roots = np.roots(spectrum)
    top = np.poly(roots[np.abs(roots) < 1]).real
    return top, poles, float(np.sqrt(spectrum.sum()) / top.sum())


def _output_std(poles: np.ndarray) -> float:
    """Return the standard deviation of white noise of variance 1 filtered by 1/poles."""
    pulse = np.zeros(100_000)
    pulse[0] = 1.0
    return float(np.linalg.norm(filtered([1.0], poles, pulse)))
