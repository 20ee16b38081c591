"""Search, over frequencies and dampings, for the next mode that explains most of a model's residual.

    e = (b₁ z⁻¹ + b₂ z⁻²)/(1 − 2 Re λ z⁻¹ + |λ|² z⁻²) û        pair,     e = b z⁻¹/(1 − λ z⁻¹) û        real pole

For each λ of a grid the residues are least squares in closed form over the spectra of e and û, both whitened; around
the best of each damping the grid is made finer twice (a matching pursuit, Mallat & Zhang 1993).
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Complex, Real

Number = TypeVar("Number", np.float64, np.complex128)

DAMPINGS = (0.01, 0.05, 0.25, 0.8)
GRID_SPACING = 2.0
"""Distance of grid points, relative to a pair's width: a lightly damped mode between points farther apart is missed."""
REAL_POINTS, ZOOM_POINTS, ZOOMS = 90, 9, 2
HIGHEST_SHARE = 0.9
"""Highest frequency searched, as a fraction of half the sampling rate."""
RESOLUTION_HZ = 0.25
"""Spectral lines of long recordings are summed over this width."""
LEAST_PERIODS = 5
"""Least number of periods of the slowest mode within the recording."""
PARAMETERS = {True: 4, False: 2}
"""Number of parameters of a mode: of a pair (True), of a real pole (False)."""


class Spectra:
    """Spectra of a residual (samples,) and of the input (samples,), both whitened alike."""

    def __init__(self, residual: Real, driven: Real, period_s: float) -> None:
        """Compute the spectra of `residual` and of the input `driven`, each (samples,), which are whitened alike."""
        size = 1 << (2 * residual.size - 1).bit_length()
        spectrum = np.fft.rfft(driven, size)
        block_size = max(1, int(RESOLUTION_HZ * size * period_s))
        self._power = _block_sums(np.abs(spectrum) ** 2, block_size)
        self._cross = _block_sums(np.conj(spectrum) * np.fft.rfft(residual, size), block_size)
        middles = block_size * np.arange(self._power.size) + (block_size - 1) / 2
        self._delay_factors: Complex = np.exp(-2j * np.pi * middles / size)
        self._period_s = period_s
        self._variance = float(np.sum(residual**2)) * size / 2 / residual.size
        self._slowest = 2 * np.pi * LEAST_PERIODS / (residual.size * period_s)

    def find_mode(self, *, pair_allowed: bool) -> complex:
        """Return the rate s (rad/s) of the mode that explains most of the residual, less Akaike's penalty.

        It is a real pole or, only if `pair_allowed`, the pole of a pair with positive imaginary part.
        """
        top = HIGHEST_SHARE * np.pi / self._period_s
        real_gain, real = self._choose_rate((-np.geomspace(self._slowest, top, REAL_POINTS)).astype(complex))
        if not pair_allowed:
            return real
        pair_gain, pair = max((self._find_pair(damping, top) for damping in DAMPINGS), key=lambda scored: scored[0])
        gains = {True: pair_gain, False: real_gain}
        return pair if self._net_gain(gains, pair=True) >= self._net_gain(gains, pair=False) else real

    def _find_pair(self, damping: float, top: float) -> tuple[float, complex]:
        """Return the explained energy and the rate (rad/s) of the best pair near `damping`, up to `top` rad/s.

        Each of DAMPINGS is searched separately: a search that starts at a broad pair does not reach a light one.
        """
        count = int(np.log(top / self._slowest) / np.log1p(GRID_SPACING * damping)) + 2
        gain, pair = self._choose_rate(_pair_rates(np.geomspace(self._slowest, top, count), np.array([damping])))
        step = 1 + GRID_SPACING * damping
        for _ in range(ZOOMS):
            near = abs(pair) * np.geomspace(1 / step, step, ZOOM_POINTS)
            dampings = -pair.real / abs(pair) * np.geomspace(0.4, 2.5, 5)
            gain, pair = max(
                (gain, pair), self._choose_rate(_pair_rates(near, dampings[dampings < 1])), key=lambda scored: scored[0]
            )
            step **= 2 / (ZOOM_POINTS - 1)
        return gain, pair

    def _net_gain(self, gains: dict[bool, float], *, pair: bool) -> float:
        """Return `gains[pair]`, the energy that a pair (True) or a real pole (False) explains, less Akaike's penalty.

        The penalty is two variances per parameter.
        """
        return gains[pair] - 2 * PARAMETERS[pair] * self._variance

    def _choose_rate(self, rates: Complex) -> tuple[float, complex]:
        """Return the largest explained energy and, second, the rate of `rates` (k,) whose mode explains it."""
        return max(((self._mode_energy(rate), complex(rate)) for rate in rates), key=lambda scored: scored[0])

    def _mode_energy(self, rate: complex) -> float:
        """Return the energy of the residual that a mode at `rate` (rad/s) explains with its best residues."""
        z_pole = np.exp(rate * self._period_s)
        if rate.imag == 0:
            mode_response = self._delay_factors / (1 - z_pole.real * self._delay_factors)
            return float(
                (np.conj(mode_response) @ self._cross).real ** 2 / ((np.abs(mode_response) ** 2) @ self._power)
            )
        mode_response = 1 / (1 - 2 * z_pole.real * self._delay_factors + abs(z_pole) ** 2 * self._delay_factors**2)
        weight = np.abs(mode_response) ** 2 * self._power
        weighted_cross = np.conj(mode_response * self._delay_factors) * self._cross
        auto_energy, cross_energy = weight.sum(), weight @ self._delay_factors.real
        right_side = np.array([weighted_cross.sum().real, (weighted_cross @ np.conj(self._delay_factors)).real])
        return float(
            right_side
            @ np.linalg.solve(
                [[auto_energy * (1 + 1e-12), cross_energy], [cross_energy, auto_energy * (1 + 1e-12)]], right_side
            )
        )


def _pair_rates(sizes: Real, dampings: Real) -> Complex:
    """Return the upper rate in rad/s of every combination of |s| and damping, (sizes · dampings,)."""
    return np.outer(sizes, -dampings + 1j * np.sqrt(1 - dampings**2)).ravel()


def _block_sums(lines: npt.NDArray[Number], block_size: int) -> npt.NDArray[Number]:
    """Return the sums of `block_size` successive lines, (blocks,); the last block may be shorter."""
    return np.add.reduceat(lines, np.arange(0, lines.size, block_size))
