"""C(z), a PI part and second-order sections, from the numbers that a search varies.

    C(z) = k (z − z₀)/(z − 1) · Π (z² + n₁z + n₂)/(z² + d₁z + d₂)

Numbers of a point: log k, log(1 − z₀), then for each section log ω and ζ of its zeros, log ω and log ζ of its poles,
ω in radians a sample; roots are exp(−ζω ± jω√(1 − ζ²)). Poles are stable, zeros may be anywhere.
"""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple

import numpy as np

from rtloop.foundation.arrays import Complex, Real
from rtloop.linear.discretise import discretise_transfer
from rtloop.linear.transfer import Transfer

FASTEST, SLOWEST = 2.5, 1e-3
"""Radians a sample of a root; at π a pair would fold over."""
LOWEST = [math.log(1e-9), -9.0]
HIGHEST = [math.log(1e6), -0.01]
"""Largest log k and log(1 − z₀) of a point; LOWEST has the least."""
SECTION = [(math.log(SLOWEST), math.log(FASTEST)), (-1.5, 4.0), (math.log(SLOWEST), math.log(FASTEST)), (-4.0, 1.6)]
"""Least and largest value of each of the four numbers of a section in a point."""


class Candidates(NamedTuple):
    """k controllers: gains (k,), zeros z₀ of the PI part (k,), and the coefficients (c₁, c₂) of z² + c₁z + c₂ in
    numerator and denominator of m sections, each (k, m, 2).
    """

    gain: Real
    zero: Real
    numerators: Real
    denominators: Real

    def response(self, z: Complex) -> Complex:
        """Return the complex responses of the k controllers at points (f,) of the z plane, (k, f)."""
        value = self.gain[:, None] * (z - self.zero[:, None]) / (z - 1)
        for i in range(self.numerators.shape[1]):
            value = value * _quadratic(self.numerators[:, i], z) / _quadratic(self.denominators[:, i], z)
        return value

    def matrices(self) -> tuple[Real, Real, Real, Real]:
        """Return A (k, n, n), b (k, n), c (k, n), d (k,) of the PI part and the sections in series, n = 1 + 2m."""
        count, sections = self.numerators.shape[:2]
        n = 1 + 2 * sections
        a, b, c = np.zeros((count, n, n)), np.zeros((count, n)), np.zeros((count, n))
        a[:, 0, 0], b[:, 0], c[:, 0] = 1.0, 1.0, self.gain * (1 - self.zero)
        for i in range(sections):
            row = 1 + 2 * i
            a[:, row, row : row + 2], a[:, row + 1, row] = -self.denominators[:, i], 1.0
            a[:, row, :row], b[:, row] = c[:, :row], self.gain
            c[:, row : row + 2] = self.numerators[:, i] - self.denominators[:, i]
        return a, b, c, self.gain


def point_bounds(sections: int) -> tuple[Real, Real]:
    """Return the least and the largest values, each (2 + 4·sections,), of a point of the search for a controller with
    `sections` sections of second order.

    A point is log k, log(1 − z₀), then for each section log ω and ζ of its zeros, log ω and log ζ of its poles, with ω
    in radians a sample.
    """
    low, high = zip(*(SECTION * sections), strict=True)
    return np.array([*LOWEST, *low]), np.array([*HIGHEST, *high])


def build_candidates(points: Real) -> Candidates:
    """Return the controllers of points (k, 2 + 4m), which must lie within `point_bounds(m)`.

    A point is log k, log(1 − z₀), then for each section log ω and ζ of its zeros, log ω and log ζ of its poles, with ω
    in radians a sample.
    """
    sections = points[:, 2:].reshape(points.shape[0], -1, 4)
    numerators = _coefficients(np.exp(sections[..., 0]), sections[..., 1])
    denominators = _coefficients(np.exp(sections[..., 2]), np.exp(sections[..., 3]))
    return Candidates(np.exp(points[:, 0]), 1 - np.exp(points[:, 1]), numerators, denominators)


def point_transfer(point: Real, period_s: float) -> Transfer:
    """Return C(s) that the method "matched" maps to the C(z) of `point` (n,), as of `build_candidates`, root by root.

    No root is infinite, and each has |Im s| below π/`period_s`.
    """
    sections = point[2:].reshape(-1, 4)
    zero_rates = [root for size, damping, _, _ in sections for root in _rates(math.exp(size), damping)]
    pole_rates = [root for _, _, size, damping in sections for root in _rates(math.exp(size), math.exp(damping))]
    zeros: Complex = np.array([math.log1p(-math.exp(point[1])), *zero_rates]) / complex(period_s)
    poles: Complex = np.array([0.0, *pole_rates]) / complex(period_s)
    image = discretise_transfer(Transfer(zeros, poles, 1.0), period_s, "matched")
    return Transfer(zeros, poles, math.exp(point[0]) / image.gain)


def _coefficients(size: Real, damping: Real) -> Real:
    """Return (c₁, c₂), (…, 2), of z² + c₁z + c₂ with roots exp(ω(−ζ ± √(ζ² − 1))), ω = `size` in radians a sample."""
    spread = size * np.sqrt(damping**2 - 1 + 0j)
    decay = np.exp(-size * damping)
    return np.stack([-2 * decay * np.real(np.cosh(spread)), decay**2], axis=-1)


def _rates(size: float, damping: float) -> list[complex]:
    """Return both roots ω(−ζ ± √(ζ² − 1)), in radians a sample for ω = `size`."""
    spread = cmath.sqrt(damping**2 - 1)
    return [size * (-damping + spread), size * (-damping - spread)]


def _quadratic(coefficients: Real, z: Complex) -> Complex:
    """Return z² + c₁z + c₂ for `coefficients` (k, 2) at points (f,), (k, f)."""
    return z * z + coefficients[:, :1] * z + coefficients[:, 1:]
