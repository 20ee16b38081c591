"""A measured loop as a curve: every line smoothed with its neighbours, and interpolated between the lines.

Where a lightly damped mode λ was found, L·(z − λ) is smoothed and interpolated: L itself turns by half a circle from
one line to the next there, and L·(z − λ) does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from rtloop.analysis.measured.mode import LightMode
from rtloop.analysis.measured.response import MeasuredResponse
from rtloop.foundation.arrays import Complex, Real

HALF_WIDTHS = (2, 4, 8, 16)
"""Half widths, in lines, of the windows in which neighbouring lines are combined."""
RESIDUAL_DEVIATIONS = 3.0
"""Standard deviations by which a window's residuals may exceed the uncertainty."""
POINTS = 8
"""Points of the grid for each measured line."""


@dataclass(frozen=True)
class MeasuredLoop:
    """Measured loop L as a curve: L·(z − λ), `lifted` (k,), at the lines `hz` (k,).

    `spread` (k,) is the standard deviation of L relative to its magnitude. `image` is the pole λ of the lightly damped
    mode in z; for None, `lifted` is L.
    """

    hz: Real
    lifted: Complex
    spread: Real
    rate_hz: float
    image: complex | None
    static_gain: float = math.nan
    period_s: None = None
    """Always None: the loop at half the rate is not measured, nor is `static_gain` at 0 Hz."""

    @cached_property
    def frequencies(self) -> Real:
        """The lines in Hz, rising, with POINTS − 1 points between each two, evenly on a logarithmic scale."""
        lines = np.arange(self.hz.size)
        return np.exp(np.interp(np.arange(lines[-1] * POINTS + 1) / POINTS, lines, np.log(self.hz)))

    @property
    def loop(self) -> Complex:
        """Open loop L at the measured lines, complex (k,)."""
        return self.lifted / _pole_distance(self.hz, self.rate_hz, self.image)

    def open(self, hz: npt.ArrayLike) -> Complex:
        """Return the open loop L at frequencies (k,) in Hz, by a cubic spline over the logarithm of the frequency.

        Beyond the measured lines, the spline is extrapolated.
        """
        at = np.atleast_1d(np.asarray(hz, dtype=float))
        return np.asarray(self._spline(np.log(at)), dtype=complex) / _pole_distance(at, self.rate_hz, self.image)

    def sensitivity(self, hz: npt.ArrayLike) -> Real:
        """Return |S| = 1/|1 + L| (k,) at frequencies (k,) in Hz."""
        return 1 / np.abs(1 + self.open(hz))

    def perturbed(self, part: complex) -> MeasuredLoop:
        """Return the loop with L everywhere times 1 + `part`·`spread`: real `part` changes |L|, imaginary `part` its
        phase.
        """
        lifted = self.lifted * (1 + part * self.spread)
        return MeasuredLoop(self.hz, lifted, self.spread, self.rate_hz, self.image)

    @cached_property
    def _spline(self) -> Callable[[npt.ArrayLike], Complex]:
        """Cubic spline over ln f of L·(z − λ) with the mode's pole λ, or of L without a lightly damped mode."""
        from scipy.interpolate import CubicSpline  # half a second of import, when a service starts

        return CubicSpline(np.log(self.hz), self.lifted)


def measured_loop(measured_response: MeasuredResponse, rate_hz: float, mode: LightMode | None) -> MeasuredLoop:
    """Return the loop L = C·D of a measured response, each line smoothed with its neighbours, which lowers `spread`.

    The pole of the lightly damped `mode` (None: there is none) is divided out before and multiplied in afterwards, so
    that the peak is not smoothed.
    """
    image = None if mode is None else mode.image(rate_hz)
    raw = measured_response.plant * measured_response.controller * _pole_distance(measured_response.hz, rate_hz, image)
    lifted, std = smooth_lines(np.log(measured_response.hz), raw, measured_response.spread * np.abs(raw))
    return MeasuredLoop(measured_response.hz, lifted, std / np.abs(lifted), rate_hz, image)


def _pole_distance(hz: Real, rate_hz: float, image: complex | None) -> Complex:
    """Return z − λ (k,) at frequencies (k,) in Hz, for λ = `image`; 1 for None."""
    return np.ones(hz.shape, complex) if image is None else np.exp(2j * np.pi * hz / rate_hz) - image


def smooth_lines(place: Real, values: Complex, std: Real) -> tuple[Complex, Real]:
    """Return values (k,) smoothed with their neighbours, and their standard deviations.

    About each value, a parabola over the widest of HALF_WIDTHS up to which the residuals stay within `std`; the value
    itself where no window fits. `place` (k,) is the abscissa.
    """
    smoothed, smoothed_std = values.copy(), std.copy()
    for i in range(values.size):
        for half_width in HALF_WIDTHS:
            window = slice(max(i - half_width, 0), i + half_width + 1)
            x = place[window] - place[i]
            if x.size < half_width + 3:
                break
            rows = np.vander(x / np.abs(x).max(), 3, increasing=True) / std[window, None]
            scaled = values[window] / std[window]
            inverse = np.linalg.pinv(rows)
            solution = inverse @ scaled
            freedom = x.size - 3
            if np.sum(np.abs(scaled - rows @ solution) ** 2) / freedom > 1 + RESIDUAL_DEVIATIONS / np.sqrt(freedom):
                break
            smoothed[i], smoothed_std[i] = solution[0], float(np.linalg.norm(inverse[0]))
    return smoothed, smoothed_std
