"""Square roots of the Gramians of a stable system, found without ever forming a Gramian that could lose its digits.

    A P + P Aᵀ + b bᵀ = 0,   P = L Lᵀ

In modal coordinates P is a Cauchy matrix, P_ij = −βᵢ β̄ⱼ/(pᵢ + p̄ⱼ). Gaussian elimination keeps its form, so that
each entry of L is a product of differences and sums of poles, accurate to a few units in the last place (Gohberg,
Kailath & Olshevsky, Mathematics of Computation 64, 1995; Demmel, SIAM J. Matrix Anal. 21, 1999). Poles at −1 and at
−1e5 rad/s together do not harm it, where a Lyapunov solver and a Cholesky factorisation would lose the small Hankel
singular values.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag, solve_continuous_lyapunov

from rtloop.foundation.arrays import Complex, Real
from rtloop.foundation.modal import ModalSystem
from rtloop.linear.realisation import System


def modal_root(poles: Complex, inputs: Complex) -> Real:
    """Return L (n, n), lower triangular, with L Lᵀ the controllability Gramian of the real modal form.

    `poles` (n,) all stable, no two alike, conjugates side by side with the upper one first; `inputs` β (n,), conjugate
    alike. The real form has x = (√2 Re, √2 Im) of each upper mode, which is a unitary change of coordinates.
    """
    pair_block = np.array([[1, 1], [-1j, 1j]]) / np.sqrt(2)
    to_real = block_diag(*(np.eye(1) if pole.imag == 0 else pair_block for pole in poles if pole.imag >= 0))
    real = np.asarray(to_real, dtype=complex) @ _cauchy_root(poles, inputs)
    return np.asarray(np.linalg.qr(np.hstack([real.real, real.imag]).T, mode="r"), dtype=float).T


def system_roots(system: System) -> tuple[Real, Real]:
    """Return roots (L, R) of the controllability Gramian P = L Lᵀ and the observability Gramian Q = R Rᵀ, each (n, n),
    of a stable system in any form, from Lyapunov equations.
    """
    p = solve_continuous_lyapunov(system.a, -np.outer(system.b, system.b))
    q = solve_continuous_lyapunov(system.a.T, -np.outer(system.c, system.c))
    return _gramian_root(p), _gramian_root(q)


def real_modal_system(modal: ModalSystem) -> System:
    """Return the real form whose Gramians `modal_root` factors: inputs √|r|, outputs r/√|r|, of equal size.

    Each pair has two states, (√2 Re, √2 Im) of its upper mode.
    """
    upper = modal.poles.imag >= 0
    a, b, c = [], [], []
    for pole, beta, gamma in zip(modal.poles[upper], *(vector[upper] for vector in modal_vectors(modal)), strict=True):
        if pole.imag == 0:
            a.append(np.array([[pole.real]]))
            b.append([beta.real])
            c.append([gamma.real])
        else:
            a.append(np.array([[pole.real, -pole.imag], [pole.imag, pole.real]]))
            b.append([np.sqrt(2) * beta.real, np.sqrt(2) * beta.imag])
            c.append([np.sqrt(2) * gamma.real, -np.sqrt(2) * gamma.imag])
    if not a:
        return System(np.empty((0, 0)), np.empty(0), np.empty(0), float(modal.direct[0]))
    return System(np.asarray(block_diag(*a), dtype=float), np.concatenate(b), np.concatenate(c), float(modal.direct[0]))


def modal_vectors(modal: ModalSystem) -> tuple[Complex, Complex]:
    """Return input gains β and output gains γ (n,) of the modes with residues r: γᵢβᵢ = rᵢ and |βᵢ| = |γᵢ|."""
    residues = modal.residues[0]
    beta = np.sqrt(np.abs(residues)).astype(complex)
    return beta, np.divide(residues, beta, out=np.zeros_like(residues), where=beta != 0)


def _cauchy_root(poles: Complex, inputs: Complex) -> Complex:
    """Return F (n, n) with F Fᴴ = P, the controllability Gramian of modes with `poles` and `inputs` β (n,).

    Elimination takes the largest pivot first; each step multiplies, none subtracts entries of P.
    """
    remaining = inputs.astype(complex)
    factor = np.zeros((poles.size, poles.size), dtype=complex)
    for k in range(poles.size):
        diagonal = np.abs(remaining) ** 2 / (-2 * poles.real)
        pivot = int(np.argmax(diagonal))
        if diagonal[pivot] == 0:
            break
        factor[:, k] = (
            -remaining * np.conj(remaining[pivot]) / (poles + np.conj(poles[pivot])) / np.sqrt(diagonal[pivot])
        )
        remaining = remaining * (poles - poles[pivot]) / (poles + np.conj(poles[pivot]))
        remaining[pivot] = 0.0
    return factor


def _gramian_root(gramian: Real) -> Real:
    """Return L (n, n) with L Lᵀ = `gramian`; eigenvalues below 0 count as 0."""
    values, vectors = np.linalg.eigh(gramian)
    return vectors * np.sqrt(np.maximum(values, 0.0))
