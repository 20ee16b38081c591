"""The H∞ norm of a stable system, and of a weighted loop: the largest singular value of its frequency response.

Bruinsma & Steinbuch 1990 (after Boyd, Balakrishnan & Kabamba 1989): γ is exceeded somewhere if and only if a
Hamiltonian matrix has eigenvalues on the imaginary axis, and those are the frequencies at which a singular value
crosses γ. Between two of them lies a higher point; a few rounds find the peak, however narrow.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rtloop.analysis.closed_loop import realise_transfer
from rtloop.design.synthesis.hinf.augment import GeneralisedPlant, Matrices
from rtloop.foundation.arrays import Real, rising_grid
from rtloop.linear.transfer import Transfer


class Peak(NamedTuple):
    """The norm, and the frequency (rad/s) where it is reached: inf for the direct part alone; for an unstable system,
    |p| of its pole farthest right.
    """

    norm: float
    omega: float


def hinf_norm(system: Matrices, tolerance: float = 1e-6) -> Peak:
    """Return the H∞ norm, too small by at most `tolerance` of it, and its frequency in rad/s, inf for the direct part.

    For an unstable system the norm is inf, and the frequency |p| of its pole farthest right.
    """
    poles = np.linalg.eigvals(system.a)
    if np.any(poles.real >= 0):
        return Peak(math.inf, float(np.abs(poles[np.argmax(poles.real)])))
    grid = np.concatenate([[0.0], np.abs(poles), np.abs(poles.imag)])
    direct_gain = float(np.linalg.norm(system.d, 2)) if system.d.size else 0.0
    highest = max(_highest_gain(system, grid), Peak(direct_gain, math.inf))
    for _ in range(60):
        crossings = _crossings(system, (1 + tolerance) * highest.norm)
        if crossings.size < 2:
            return highest
        middles = 0.5 * (crossings[1:] + crossings[:-1])
        highest = max(
            highest, _highest_gain(system, np.concatenate([middles, np.sqrt(crossings[1:] * crossings[:-1])]))
        )
    return highest


def weighted_norm(standard: GeneralisedPlant, controller: Transfer) -> float:
    """Return the H∞ norm of the weighted closed loop, ‖F_l(P, C)‖∞ of eq (9): the factor by which the worst
    specification is missed; infinite if unstable.
    """
    a, b, c, d = realise_transfer(controller)
    return hinf_norm(standard.close_loop(Matrices(a, b[:, None], c[None, :], np.array([[d]])))).norm


def _highest_gain(system: Matrices, omega: Real) -> Peak:
    """Return the largest singular value over frequencies (rad/s), and its frequency."""
    values = np.linalg.norm(system.response((1j * omega).astype(complex)), 2, axis=(1, 2))
    return max(Peak(float(value), float(frequency)) for value, frequency in zip(values, omega, strict=True))


def _crossings(system: Matrices, gamma: float) -> Real:
    """Return the frequencies ≥ 0 in rad/s, rising, at which a singular value equals `gamma`.

    If their number is odd, 0 comes before them: the lowest one then pairs with its mirror image below 0. There are none
    for `gamma` 0.
    """
    if gamma == 0:
        return np.empty(0)
    a, b, c, d = system
    r = gamma**2 * np.eye(b.shape[1]) - d.T @ d
    inner = np.linalg.solve(r, np.hstack([d.T @ c, b.T]))
    n = a.shape[0]
    hamiltonian = np.block([[a, np.zeros((n, n))], [-c.T @ c, -a.T]]) + np.vstack([b, -c.T @ d]) @ inner
    values = np.linalg.eigvals(hamiltonian)
    upper = np.abs(values.real) < 1e-8 * np.abs(values)
    frequencies = rising_grid([np.abs(values[upper].imag)])
    return np.concatenate([[0.0], frequencies]) if frequencies.size % 2 else frequencies
