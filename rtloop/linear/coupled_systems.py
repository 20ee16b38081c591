"""Systems with as many inputs as outputs: what controllers of several axes, and the stages that they move, are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from rtloop.foundation.arrays import Complex, Real
from rtloop.linear.realisation import System

DC_OFFSET = 1e-9
"""So far from z = 1 an integrator's response is taken: it has none there."""


class CoupledSystem(NamedTuple):
    """x⁺ = A x + B u, y = C x + D u (or x' for x⁺): `a` (n, n), `b` (n, m), `c` (m, n), `d` (m, m)."""

    a: Real
    b: Real
    c: Real
    d: Real

    def response(self, complex_points: npt.ArrayLike) -> Complex:
        """D + C (xI − A)⁻¹ B at complex points `at` (k,), shape (k, m, m)."""
        points = np.atleast_1d(np.asarray(complex_points, dtype=complex))
        pencil = points[:, None, None] * np.eye(self.a.shape[0]) - self.a
        states = np.linalg.solve(pencil, np.broadcast_to(self.b, (points.size, *self.b.shape)))
        return np.asarray(self.d + self.c @ states, np.complex128)

    def transform(self, before: npt.ArrayLike | None = None, after: npt.ArrayLike | None = None) -> CoupledSystem:
        """The system behind a matrix, or in front of one, (m, m)."""
        first = np.eye(self.d.shape[1]) if before is None else np.asarray(before, float)
        last = np.eye(self.d.shape[0]) if after is None else np.asarray(after, float)
        return CoupledSystem(self.a, self.b @ first, last @ self.c, last @ self.d @ first)


def block_diagonal_system(systems: list[System]) -> CoupledSystem:
    """Systems of one input and one output each, none of which knows of the others."""
    return CoupledSystem(
        np.asarray(block_diag(*(system.a for system in systems))),
        _state_columns([system.b for system in systems]),
        _state_columns([system.c for system in systems]).T,
        np.diag([system.d for system in systems]),
    )


def _state_columns(vectors: list[Real]) -> Real:
    """A column for each vector, which stands in it where its states are."""
    matrix, row = np.zeros((sum(vector.size for vector in vectors), len(vectors))), 0
    for column, vector in enumerate(vectors):
        matrix[row : row + vector.size, column] = vector
        row += vector.size
    return matrix


def tustin(system: CoupledSystem, period_s: float, prewarp_hz: float | None = None) -> CoupledSystem:
    """By the bilinear rule, s = w (z − 1)/(z + 1). Raises ValueError for a frequency or a pole that cannot be."""
    w = 2 / period_s
    if prewarp_hz is not None:
        if not 0 < prewarp_hz < 0.5 / period_s:
            allowed = f"between 0 and half the sampling rate, {0.5 / period_s:g} Hz, is allowed"
            raise ValueError(f"prewarp_hz: {prewarp_hz!r}; {allowed}")
        w = 2 * np.pi * prewarp_hz / np.tan(np.pi * prewarp_hz * period_s)
    states = np.eye(system.a.shape[0])
    try:
        inverse = np.linalg.inv(w * states - system.a)
    except np.linalg.LinAlgError:
        raise ValueError(f"a: a pole at s = {w:g} has no image; another period is needed") from None
    return CoupledSystem(
        inverse @ (w * states + system.a),
        np.sqrt(2 * w) * inverse @ system.b,
        np.sqrt(2 * w) * system.c @ inverse,
        system.d + system.c @ inverse @ system.b,
    )


@dataclass(frozen=True, eq=False)
class SampledCoupledSystem:
    """A controller of several axes, known by its matrices: from errors to commands, at one period."""

    system: CoupledSystem
    period_s: float

    @property
    def order(self) -> int:
        """Number of states."""
        return self.system.a.shape[0]

    @property
    def count(self) -> int:
        """Of its axes."""
        return self.system.d.shape[0]

    @cached_property
    def at_rest(self) -> Real:
        """C just beside z = 1, (m, m): large in the directions that integrate."""
        return self.system.response(1.0 + DC_OFFSET)[0].real
