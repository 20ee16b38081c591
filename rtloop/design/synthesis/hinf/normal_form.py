"""A generalised plant brought to D12 = [0; I], D21 = [0 I], D22 = 0, and its controllers brought back.

Outputs z and inputs w are turned (which leaves the norm), u and y scaled. A controller K̃ found for D22 = 0 becomes
K̃ (I + D22 K̃)⁻¹. States are scaled by powers of two, so that a second beside ten microseconds costs no digits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import matrix_balance

from rtloop.design.synthesis.hinf.augment import GeneralisedPlant, Matrices
from rtloop.foundation.arrays import Real


class NormalForm(NamedTuple):
    """The plant in normal form; `to_u` (m2, m2) and `from_y` (p2, p2) lead back to u and y, `direct` is D22."""

    a: Real
    b1: Real
    b2: Real
    c1: Real
    c2: Real
    d11: Real
    to_u: Real
    from_y: Real
    direct: Real

    @property
    def matrices(self) -> tuple[Real, Real, Real, Real, Real, Real, Real, Real]:
        """A, B1, B2, C1, C2, D11, D12 = [0; I] and D21 = [0 I]."""
        m2, p2 = self.b2.shape[1], self.c2.shape[0]
        d12 = np.vstack([np.zeros((self.d11.shape[0] - m2, m2)), np.eye(m2)])
        d21 = np.hstack([np.zeros((p2, self.d11.shape[1] - p2)), np.eye(p2)])
        return self.a, self.b1, self.b2, self.c1, self.c2, self.d11, d12, d21

    def restore_controller(self, controller: Matrices) -> Matrices:
        """Return the controller for the original plant, D22 included, from a controller for the normal form."""
        a, b, c, d = controller
        b, c, d = b @ self.from_y, self.to_u @ c, self.to_u @ d @ self.from_y
        inverse = np.linalg.inv(np.eye(d.shape[1]) + self.direct @ d)  # y − D22 u = inverse (y − D22 C x)
        return Matrices(
            a - b @ inverse @ self.direct @ c, b @ inverse, c - d @ inverse @ self.direct @ c, d @ inverse
        )  # fmt: skip


def normalise(plant: GeneralisedPlant) -> NormalForm:
    """Return the normal form of a plant, with D12 = [0; I] and D21 = [0 I].

    D12 of `plant` must have full column rank, and D21 full row rank.
    """
    scale = _state_scale(plant)
    a = plant.a * scale / scale[:, None]
    b1, b2, c1, c2 = plant.b1 / scale[:, None], plant.b2 / scale[:, None], plant.c1 * scale, plant.c2 * scale
    turn_z, to_u = _normalising_pair(plant.d12)
    turn_w, from_y = _normalising_pair(plant.d21.T)
    return NormalForm(
        a, b1 @ turn_w, b2 @ to_u, turn_z.T @ c1, from_y.T @ c2, turn_z.T @ plant.d11 @ turn_w,
        to_u, from_y.T, plant.d22,
    )  # fmt: skip


def _normalising_pair(matrix: Real) -> tuple[Real, Real]:
    """Return orthogonal Q and invertible T with Qᵀ·matrix·T = [0; I], for a matrix of full column rank."""
    left_vectors, values, right_vectors = np.linalg.svd(matrix)
    count = values.size
    return np.hstack([left_vectors[:, count:], left_vectors[:, :count]]), right_vectors.T / values


def _state_scale(plant: GeneralisedPlant) -> Real:
    """Return t (n,), powers of two, with which x = t·x̃ evens out rows and columns of A, bordered by inputs and
    outputs.
    """
    n = plant.a.shape[0]
    joint = np.zeros((n + 1, n + 1))
    joint[:n, :n] = plant.a
    joint[:n, n] = np.abs(np.hstack([plant.b1, plant.b2])).sum(axis=1)
    joint[n, :n] = np.abs(np.vstack([plant.c1, plant.c2])).sum(axis=0)
    _, (scale, _) = matrix_balance(joint, permute=False, separate=True)
    return scale[:n] / scale[n]
