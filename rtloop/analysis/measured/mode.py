"""A lightly damped mode in a measured plant response: its frequency and damping with their standard deviations.

    D(z) ≈ ρ/(z − λ) + c_0 + c_1 x + c_2 x²,     λ = exp((−ζ + j√(1 − ζ²)) ω_0 T),   x = (f − f_c)/(half the band)

over a band about it: all else in D, delays and the mode's own conjugate included, is smooth there (local rational
method; McKelvey & Guérin 2012). ρ and c are complex and linear; ω_0 and ζ minimise the residuals weighted by the
measurement's own uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtloop.analysis.measured.response import MeasuredResponse
from rtloop.foundation.arrays import Complex, Real

BAND = 0.2
"""Half width of the fitted band, as a fraction of the mode's frequency."""
BACKGROUND = 3
MIN_LINES = 12
DAMPINGS = (0.002, 0.004, 0.008, 0.015, 0.03, 0.06, 0.12)
LEAST_DAMPING, LARGEST_DAMPING = 1e-5, 0.3
LARGEST_MISFIT = 2.0
"""Residuals over the uncertainty up to which the stage counts as linear. Simulated stages: 1.3 at most after an exact
inverse, 2.3 at least where hysteresis is left."""
NOT_LINEAR = (
    "hysteresis remains, so that the stage is not linear in this motion. The figures and standard deviations hold "
    "only for a repetition of this motion; they are not the margins of a linear loop"
)
"""Warning for users of a measurement whose misfit exceeds LARGEST_MISFIT."""
MIN_IMPROVEMENT = 25.0
"""Least growth of the weighted squares, over their mean, without the mode, for a mode to count as found."""


@dataclass(frozen=True)
class LightMode:
    """Frequency |s|/2π in Hz and damping ratio of a pair of poles, with standard deviations, and the fitted band.

    `misfit` is the residuals' rms over the measurement's uncertainty.
    """

    hz: float
    hz_std: float
    damping: float
    damping_std: float
    from_hz: float
    to_hz: float
    misfit: float

    def image(self, rate_hz: float) -> complex:
        """Return the pole λ in z, of positive imaginary part."""
        return _mode_image(self.hz, self.damping, rate_hz)

    def perturbed_modes(self) -> tuple[LightMode, LightMode]:
        """Return two modes: one with its frequency, one with its damping, larger by a standard deviation."""
        return replace(self, hz=self.hz + self.hz_std), replace(self, damping=self.damping + self.damping_std)


def fit_light_mode(measured: MeasuredResponse, rate_hz: float, near_hz: float, band: float = BAND) -> LightMode | None:
    """Return the lightly damped mode, with standard deviations, within `band` (a fraction) of `near_hz`.

    None where none stands out. Raises ValueError for fewer than MIN_LINES lines within the band.
    """
    from scipy.optimize import least_squares  # a quarter of a second of import, when a service starts

    in_band = np.abs(measured.hz / near_hz - 1) <= band
    if (lines := int(in_band.sum())) < MIN_LINES:
        raise ValueError(
            f"only {lines} frequencies of the multisine lie within ±{100 * band:g} % of {near_hz:g} Hz; allowed: at "
            f"least {MIN_LINES}, to identify a mode there. Use a multisine with a longer period, or with more "
            "frequencies in this band"
        )
    hz, plant = measured.hz[in_band], measured.plant[in_band]
    fit = _ModeFit(hz, plant, np.abs(plant) * measured.spread[in_band], rate_hz)
    start = min(
        ((f, z) for f in hz[1:-1:2] for z in DAMPINGS), key=lambda guess: _sum_of_squares(fit.mode_residuals(*guess))
    )
    solution = least_squares(
        lambda values: _real_and_imaginary(fit.mode_residuals(*values)),
        start,
        bounds=([hz[0], LEAST_DAMPING], [hz[-1], LARGEST_DAMPING]),
        x_scale=start,
        xtol=1e-12,
        ftol=1e-12,
    )
    squares = 2 * solution.cost
    freedom = 2 * lines - 2 * (BACKGROUND + 1) - 2
    scale = max(squares / freedom, 1e-300)
    if (_sum_of_squares(fit.smooth_residuals()) - squares) / scale < MIN_IMPROVEMENT:
        return None
    # a complex residual of standard deviation 1 has parts of variance ½
    std = np.sqrt(np.diag(np.linalg.inv(solution.jac.T @ solution.jac)) * max(0.5, scale))
    f, z = solution.x
    return LightMode(
        float(f), float(std[0]), float(z), float(std[1]), float(hz[0]), float(hz[-1]), float(np.sqrt(2 * scale))
    )


class _ModeFit:
    """Residuals of D at `hz` (k,) with and without a mode, in standard deviations.

    `plant` (k,) is the measured D, `std` (k,) its standard deviation.
    """

    def __init__(self, hz: Real, plant: Complex, std: Real, rate_hz: float) -> None:
        """Prepare fits to `plant` (k,) at the lines `hz` (k,), weighted by its standard deviation `std` (k,)."""
        self._points = np.exp(2j * np.pi * hz / rate_hz)
        self._rate_hz, self._std, self._scaled = rate_hz, std, plant / std
        half = 0.5 * (hz[-1] - hz[0])
        powers = np.vander((hz - hz[0]) / half - 1, BACKGROUND, increasing=True)
        self._smooth = np.asarray(powers / std[:, None], dtype=complex)

    def mode_residuals(self, hz: float, damping: float) -> Complex:
        """Return complex residuals (k,), in standard deviations, of the best fit with a mode at `hz` and a smooth
        background.
        """
        pole = _mode_image(hz, damping, self._rate_hz)
        mode = (abs(1 - abs(pole)) / (self._points - pole) / self._std)[:, None]
        return self._residuals(np.hstack([mode, self._smooth]))

    def smooth_residuals(self) -> Complex:
        """Return complex residuals of the best fit without a resonant mode, one for each measured frequency (k,), in
        standard deviations of the measurement.
        """
        return self._residuals(self._smooth)

    def _residuals(self, rows: Complex) -> Complex:
        """Return residuals (k,), plant minus fit in standard deviations, of the least-squares fit by `rows` (k,
        parameters) with complex parameters.
        """
        solution, *_ = np.linalg.lstsq(rows, self._scaled, rcond=None)
        return self._scaled - rows @ solution


def _mode_image(hz: float, damping: float, rate_hz: float) -> complex:
    """Return the pole λ in z, of positive imaginary part, of a mode with frequency `hz` (|s|/2π) and damping ratio."""
    return complex(np.exp(complex(-damping, np.sqrt(1 - damping**2)) * 2 * np.pi * hz / rate_hz))


def _real_and_imaginary(values: Complex) -> Real:
    """Return real parts (k,), then imaginary parts, (2k,)."""
    return np.concatenate([values.real, values.imag])


def _sum_of_squares(values: Complex) -> float:
    """Return Σ |values|² over all values."""
    return float(np.sum(np.abs(values) ** 2))
