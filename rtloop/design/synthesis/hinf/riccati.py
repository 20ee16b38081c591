"""Algebraic Riccati equations by their Hamiltonian matrix: X = Ric(H), so that A + R X is stable.

    AᵀX + X A + X R X + Q = 0,     H = [A R; −Q −Aᵀ]

X exists where H has no eigenvalue on the imaginary axis and its stable subspace is the graph of a matrix (Doyle,
Glover, Khargonekar & Francis 1989, section II; Laub 1979 for the ordered Schur form). R and Q need not be definite.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.linalg import matrix_balance, schur

from rtloop.foundation.arrays import Real

Fault = Literal["imaginary axis", "no graph", "indefinite"]


class NoSolution(Exception):
    """X does not exist, or is not ≥ 0; `fault` says why."""

    def __init__(self, fault: Fault) -> None:
        """Store `fault`, the reason, which is also the text of the exception."""
        super().__init__(fault)
        self.fault: Fault = fault


def stabilising_solution(hamiltonian: Real) -> Real:
    """Return X (n, n), symmetric and ≥ 0, of a Hamiltonian matrix [A R; −Q −Aᵀ] (2n, 2n), so that A + R X is stable.

    Raises NoSolution if H has eigenvalues on the imaginary axis, its stable subspace is no graph, or X is not ≥ 0.

    The states are scaled by powers of two first, and their duals inversely, so that H stays Hamiltonian: time constants
    from ten microseconds to a second are common here.
    """
    n = hamiltonian.shape[0] // 2
    scale = _symplectic_scale(hamiltonian)
    joint_scale = np.concatenate([scale, 1 / scale])
    balanced = hamiltonian * joint_scale / joint_scale[:, None]
    try:
        form, vectors, stable = schur(balanced, sort="lhp")  # pyright: ignore[reportAssignmentType]
    except np.linalg.LinAlgError:  # an eigenvalue that reordering pushes over the axis is on it
        raise NoSolution("imaginary axis") from None
    if stable != n or np.min(np.abs(np.diag(form)), initial=np.inf) <= 1e-14 * np.linalg.norm(balanced):
        raise NoSolution("imaginary axis")
    upper, lower = vectors[:n, :n], vectors[n:, :n]
    skew = upper.T @ lower - lower.T @ upper
    if np.linalg.norm(skew) > 1e-6:  # rounding has parted a pair on the axis: this subspace belongs to no symmetric X
        raise NoSolution("imaginary axis")
    if np.linalg.cond(upper) > 1e14:
        raise NoSolution("no graph")
    x = np.linalg.solve(upper.T, lower.T).T
    x = 0.5 * (x + x.T)
    eigenvalues = np.linalg.eigvalsh(x)
    if eigenvalues.min(initial=0.0) < -1e-9 * max(float(np.abs(eigenvalues).max(initial=0.0)), 1.0):
        raise NoSolution("indefinite")
    return x / scale / scale[:, None]


def _symplectic_scale(hamiltonian: Real) -> Real:
    """Return t (n,), powers of two: diag(t, 1/t) balances H as well as a symplectic scaling can (Benner 2001)."""
    n = hamiltonian.shape[0] // 2
    if not n:
        return np.empty(0)
    _, (scale, _) = matrix_balance(hamiltonian, permute=False, separate=True)
    logarithm = np.log2(scale)
    return 2.0 ** np.round(0.5 * (logarithm[:n] - logarithm[n:]))
