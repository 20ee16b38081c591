"""Linear systems as sums of modes: G(s) = d + Σ r_i / (s − p_i).

A modal sum keeps every pole to full precision where a companion form would not: the eight poles of eq (5) of the
paper give a companion matrix with a condition number near 1e44. Each mode is discretised alone and exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Complex, Real

CLUSTER_TOLERANCE = 1e-6
"""Poles closer than this, relative to their magnitude, have no usable modal sum."""


class RepeatedPoles(ValueError):
    """Poles too close to each other for a sum of modes."""


class StateSpace(NamedTuple):
    """x' = A x + b u, y = C x + d u (or the same with x⁺): one input, `len(d)` outputs."""

    a: Real
    b: Real
    c: Real
    d: Real


@dataclass(frozen=True)
class ModalSystem:
    """A system of n modes with m outputs, in s or in z: `poles` (n,), `residues` (m, n), `direct` (m,)."""

    poles: Complex
    residues: Complex
    direct: Real

    def response(self, complex_points: npt.ArrayLike) -> Complex:
        """Return the outputs' response at points (k,) of the s or z plane, shape (m, k)."""
        points = np.asarray(complex_points, dtype=complex)
        return self.direct[:, None] + self.residues @ (1.0 / (points[None, :] - self.poles[:, None]))

    def zero_order_hold(self, period_s: float) -> ModalSystem:
        """Return the exact discretisation, in z, for an input held over each period; a pole at 0 is allowed."""
        hold_factors = period_s * np.ones_like(self.poles)
        nonzero = self.poles != 0
        hold_factors[nonzero] = np.expm1(self.poles[nonzero] * period_s) / self.poles[nonzero]
        return ModalSystem(np.exp(self.poles * period_s), self.residues * hold_factors, self.direct)

    def realise(self) -> StateSpace:
        """Return a real block-diagonal realisation: 1×1 blocks for real poles, scaled rotations 2×2 for pairs.

        The blocks are in the order of `poles`; a pair stands where its pole with positive imaginary part is.
        """
        order = self.poles.size
        a, b = np.zeros((order, order)), np.zeros(order)
        c = np.zeros((self.direct.size, order))
        row = 0
        for pole, residue in zip(self.poles, self.residues.T, strict=True):
            if pole.imag < 0:
                continue
            a[row, row], b[row], c[:, row] = pole.real, 1.0, residue.real
            if pole.imag > 0:
                a[row : row + 2, row : row + 2] = [[pole.real, -pole.imag], [pole.imag, pole.real]]
                c[:, row], c[:, row + 1] = 2 * residue.real, -2 * residue.imag
                row += 1
            row += 1
        return StateSpace(a, b, c, self.direct.copy())


def conjugate_pairs(roots: npt.ArrayLike) -> Complex:
    """Return the roots of a real polynomial: the real ones, ascending, then pairs with exactly conjugate members.

    Pairs are in the order of their real parts, the root with positive imaginary part first. A root whose imaginary part
    is up to 1e-12 of its magnitude counts as real. Raises ValueError where a complex root has no conjugate within 1e-9
    of its magnitude.
    """
    values: Complex = np.asarray(roots, dtype=np.complex128).reshape(-1)
    real = np.sort(values[np.abs(values.imag) <= 1e-12 * np.abs(values)].real)
    upper = values[values.imag > 1e-12 * np.abs(values)]
    lower = list(values[values.imag < -1e-12 * np.abs(values)])
    pairs: list[complex] = []
    for root in upper[np.lexsort((upper.imag, upper.real))]:
        nearest = min(lower, key=lambda candidate, root=root: abs(candidate - np.conj(root)), default=None)
        if nearest is None or abs(nearest - np.conj(root)) > 1e-9 * abs(root):
            raise ValueError(f"the root {root:.6g} is listed without its complex conjugate, {np.conj(root):.6g}")
        lower.remove(nearest)
        pairs += [complex(root), complex(np.conj(root))]
    if lower:
        raise ValueError(f"the root {lower[0]:.6g} is listed without its complex conjugate, {np.conj(lower[0]):.6g}")
    return np.concatenate([real.astype(complex), np.asarray(pairs, dtype=complex)])


def modal_sum(zeros: npt.ArrayLike, poles: npt.ArrayLike, gain: float) -> ModalSystem:
    """Return the partial fractions of gain·Π(s − z)/Π(s − p), from the factors and never from expanded polynomials.

    The poles are in the order of `conjugate_pairs`; there is one output. Raises RepeatedPoles where two poles lie
    closer than CLUSTER_TOLERANCE times their magnitude, ValueError for more zeros than poles and for a root without its
    conjugate.
    """
    numerator, denominator = conjugate_pairs(zeros), conjugate_pairs(poles)
    if numerator.size > denominator.size:
        raise ValueError(
            f"improper: {numerator.size} zeros and {denominator.size} poles; allowed: up to as many zeros as poles"
        )
    residues = np.empty(denominator.size, dtype=complex)
    for i, pole in enumerate(denominator):
        other_poles = np.delete(denominator, i)
        if np.any(np.abs(other_poles - pole) <= CLUSTER_TOLERANCE * max(abs(pole), 1e-300)):
            raise RepeatedPoles(f"poles near {pole:.6g} are repeated, or almost; allowed: distinct poles")
        residues[i] = gain * _ratio_of_products(pole - numerator, pole - other_poles)
    direct = gain if numerator.size == denominator.size else 0.0
    return ModalSystem(denominator, residues[None, :], np.array([direct]))


def quadratic_roots(b: float, c: float) -> list[complex]:
    """Return both roots of s² + b s + c: first the upper root of a pair, or the real root of larger magnitude.

    The smaller real root is c / larger, because a difference would cancel.
    """
    half, discriminant = -b / 2, b * b / 4 - c
    if discriminant < 0:
        imag = math.sqrt(-discriminant)
        return [complex(half, imag), complex(half, -imag)]
    larger = half + math.copysign(math.sqrt(discriminant), half)
    return [larger, c / larger if larger else 0.0]


def _ratio_of_products(numerators: Complex, denominators: Complex) -> complex:
    """Return Π numerators / Π denominators, multiplied one ratio at a time to avoid overflow; either may be longer."""
    ratio = 1.0 + 0.0j
    for i in range(max(numerators.size, denominators.size)):
        ratio *= (numerators[i] if i < numerators.size else 1.0) / (denominators[i] if i < denominators.size else 1.0)
    return ratio
