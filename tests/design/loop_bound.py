"""How well modes can be known at all from a loop's recording: the Cramér-Rao bound, by numpy and scipy alone.

    cov θ ≥ (Σ ψ ψᵀ)⁻¹,     ψ = H⁻¹ ∂G/∂θ u_r / σ,     Φ_n = σ² |H|²

u_r is the command without its noise. No unbiased estimate that does not know the noise's spectrum does better, inside a
loop or outside: the recording is Gaussian, r moves its mean by S C G' r and its spectrum may be any. So it is the bound
of the open loop moved by u_r too (Forssell & Ljung 1999, section 5). Order and delay are known; λ and r of each mode in
G = Σ r/(z − λ), and an offset, are not.
"""

from __future__ import annotations

import numpy as np

from tests.design.coloured_loops import DRIFT, PERIOD_S, SENSOR_UM, SHAKEN, TrueLoop, colours, filtered


def bounds_percent(loop: TrueLoop, driven_um: np.ndarray, near_hz: float, rms_um: float) -> np.ndarray:
    """(modes, 2): least standard deviations of frequency and damping, in percent of them."""
    driven = np.concatenate([np.zeros(loop.delay_ticks), driven_um[: driven_um.size - loop.delay_ticks]])
    rows = [np.ones(driven.size)]
    for hz, damping, share in loop.modes:
        rate = 2 * np.pi * hz * (-damping + 1j * np.sqrt(1 - damping**2))
        image = np.exp(rate * PERIOD_S)
        residue = share * abs(rate) ** 2 / (2j * rate.imag) * (image - 1) / rate
        mode = filtered([0, 1], [1, -image], driven.astype(complex))
        for part in (PERIOD_S * image * residue * filtered([0, 1], [1, -image], mode), mode):
            rows += [2 * np.real(part), -2 * np.imag(part)]
    top, bottom, sigma = shape_of(near_hz, rms_um)
    seen = filtered(bottom, top, np.array(rows)) / sigma
    sizes = np.linalg.norm(seen, axis=1)
    least = np.linalg.inv((seen / sizes[:, None]) @ (seen / sizes[:, None]).T) / np.outer(sizes, sizes)
    found = []
    for i, (hz, damping, _) in enumerate(loop.modes):
        part = least[4 * i + 1 : 4 * i + 3, 4 * i + 1 : 4 * i + 3]
        omega, real, imag = 2 * np.pi * hz, -damping, np.sqrt(1 - damping**2)
        slopes = np.array([[real, imag], np.array([-(imag**2), real * imag]) / damping]) / omega
        found.append(100 * np.sqrt(np.diag(slopes @ part @ slopes.T)))
    return np.array(found)


def shape_of(near_hz: float, rms_um: float) -> tuple[np.ndarray, np.ndarray, float]:
    """H as polynomials in 1/z, and σ, of the noise `coloured`: the factor of the sum of its parts' spectra."""
    shaken, drift = colours(near_hz)
    poles = np.convolve(shaken, drift)
    parts = [
        (SENSOR_UM, poles),
        (SHAKEN * rms_um / _spread(shaken), drift),
        (DRIFT * rms_um / _spread(drift), shaken),
    ]
    spectra = [np.convolve(size * one, size * one[::-1]) for size, one in parts]
    spectrum = np.sum([np.pad(one, (poles.size - 1 - one.size // 2,)) for one in spectra], axis=0)
    roots = np.roots(spectrum)
    top = np.poly(roots[np.abs(roots) < 1]).real
    return top, poles, float(np.sqrt(spectrum.sum()) / top.sum())


def _spread(poles: np.ndarray) -> float:
    """Of 1/poles behind white noise of variance 1."""
    pulse = np.zeros(100_000)
    pulse[0] = 1.0
    return float(np.linalg.norm(filtered([1.0], poles, pulse)))
