"""Systems with as many inputs as outputs, for controllers of several axes and for coupled stages."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Complex, Real
from rtloop.linear.discretise import bilinear_factor
from rtloop.linear.matrices import block_diagonal
from rtloop.linear.realisation import System

DC_OFFSET = 1e-9
"""Distance from z = 1 of the point that stands for 0 Hz: an integrator's response at z = 1 is infinite."""


class CoupledSystem(NamedTuple):
    """State space x⁺ = A x + B u, y = C x + D u (or x' for x⁺): `a` (n, n), `b` (n, m), `c` (m, n), `d` (m, m).

    A controller with its reference has 2 m inputs: the errors, then the references at errors of 0.
    """

    a: Real
    b: Real
    c: Real
    d: Real

    def response(self, complex_points: npt.ArrayLike) -> Complex:
        """Return D + C (xI − A)⁻¹ B at complex points (k,), shape (k, m, m).

        Raises LinAlgError at an eigenvalue of A.
        """
        points = np.atleast_1d(np.asarray(complex_points, dtype=complex))
        pencil = points[:, None, None] * np.eye(self.a.shape[0]) - self.a
        states = np.linalg.solve(pencil, np.broadcast_to(self.b, (points.size, *self.b.shape)))
        return np.asarray(self.d + self.c @ states, np.complex128)

    def transform(self, before: npt.ArrayLike | None = None, after: npt.ArrayLike | None = None) -> CoupledSystem:
        """Return the system with matrices (m, m) in series at its input (`before`) and output (`after`); None for the
        identity.
        """
        first = np.eye(self.d.shape[1]) if before is None else np.asarray(before, float)
        last = np.eye(self.d.shape[0]) if after is None else np.asarray(after, float)
        return CoupledSystem(self.a, self.b @ first, last @ self.c, last @ self.d @ first)


def block_diagonal_system(systems: list[System]) -> CoupledSystem:
    """Combine independent systems of one input and one output each into one, with the states in the same order."""
    return CoupledSystem(
        block_diagonal([system.a for system in systems]),
        _state_columns([system.b for system in systems]),
        _state_columns([system.c for system in systems]).T,
        np.diag([system.d for system in systems]),
    )


def _state_columns(vectors: list[Real]) -> Real:
    """Return a matrix (sum of sizes, vectors): vector i is in column i, in its own rows; 0 elsewhere."""
    matrix, row = np.zeros((sum(vector.size for vector in vectors), len(vectors))), 0
    for column, vector in enumerate(vectors):
        matrix[row : row + vector.size, column] = vector
        row += vector.size
    return matrix


def tustin(system: CoupledSystem, period_s: float, prewarp_hz: float | None = None) -> CoupledSystem:
    """Return a system discretised by the bilinear rule, which maps `prewarp_hz`, if set, to itself.

    Raises ValueError like `bilinear_factor`, and for a pole at s = w, the factor of the rule.
    """
    w = bilinear_factor(period_s, prewarp_hz)
    states = np.eye(system.a.shape[0])
    try:
        inverse = np.linalg.inv(w * states - system.a)
    except np.linalg.LinAlgError:
        raise ValueError(
            f"a: the matrix has a pole at s = {w:g} rad/s, which the bilinear rule moves to infinity; use another rate"
        ) from None
    return CoupledSystem(
        inverse @ (w * states + system.a),
        np.sqrt(2 * w) * inverse @ system.b,
        np.sqrt(2 * w) * system.c @ inverse,
        system.d + system.c @ inverse @ system.b,
    )


@dataclass(frozen=True, eq=False)
class SampledCoupledSystem:
    """A linear controller of several axes at one period, from errors to commands.

    `with_reference` and `reference_fault` are as in SampledController.
    """

    system: CoupledSystem
    period_s: float
    with_reference: CoupledSystem | None = None
    reference_fault: str = ""

    @property
    def order(self) -> int:
        """Number of states of the controller."""
        return self.system.a.shape[0]

    @property
    def count(self) -> int:
        """Number of axes of the controller."""
        return self.system.d.shape[0]

    @cached_property
    def dc_gain(self) -> Real:
        """C(1 + DC_OFFSET), (m, m), which stands for 0 Hz; large, but finite, in directions that integrate."""
        return self.system.response(1.0 + DC_OFFSET)[0].real
