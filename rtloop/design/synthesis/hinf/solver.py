"""H∞ synthesis: the controller that keeps the loop from w to z below γ, and the smallest γ for which there is one.

The general formulas (D11 ≠ 0, D22 ≠ 0) of Glover & Doyle, Systems & Control Letters 11, 1988, as in Zhou, Doyle &
Glover, Robust and Optimal Control, 1996, theorem 17.1; the state-space idea is by Doyle, Glover, Khargonekar &
Francis, IEEE TAC 34, 1989. Two Riccati equations decide whether a γ can be reached, and bisection finds the smallest
that can.

At γ_opt itself I − γ⁻²·Y·X is singular, and the controller has a pole that goes to infinity: use a slightly larger γ.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import sqrtm

from rtloop.design.synthesis.hinf.assumptions import NoController, check_assumptions
from rtloop.design.synthesis.hinf.augment import GeneralisedPlant, Matrices
from rtloop.design.synthesis.hinf.norm import hinf_norm
from rtloop.design.synthesis.hinf.normal_form import NormalForm, normalise
from rtloop.design.synthesis.hinf.riccati import Fault, NoSolution, stabilising_solution
from rtloop.foundation.arrays import Real

LARGEST_GAMMA = 1e8
"""γ up to which a controller is searched for."""


class Hinf(NamedTuple):
    """`controller` from y to u; the loop from w to z with it has the norm `achieved`, at most 1.01·`gamma`.

    `gamma_opt` is the least γ, to a relative tolerance; `limiting` the condition that fails just below it.
    """

    controller: Matrices
    gamma: float
    gamma_opt: float
    achieved: float
    limiting: str


class _Solutions(NamedTuple):
    """X∞, Y∞, and the state feedback F (m, n) and output injection L (n, p) that belong to them."""

    x: Real
    y: Real
    f: Real
    injection: Real


def synthesise_hinf(
    plant: GeneralisedPlant, gamma: float | None = None, backoff: float = 0.004, tolerance: float = 1e-7
) -> Hinf:
    """Synthesise the central controller, of the plant's order, at `gamma`; None takes (1 + `backoff`)·γ_opt.

    `tolerance` is the largest relative error of γ_opt. Raises NoController if an assumption fails, if no γ up to
    LARGEST_GAMMA can be reached, if `gamma` cannot be reached, and if the controller's loop exceeds γ by more than 1 %
    because of rounding errors.
    """
    check_assumptions(plant)
    normal_form = normalise(plant)
    gamma_opt, limiting = smallest_gamma(normal_form, tolerance)
    target_gamma = gamma_opt * (1 + backoff) if gamma is None else gamma
    try:
        controller = normal_form.restore_controller(
            _central_controller(normal_form, _solve_riccati_pair(normal_form, target_gamma), target_gamma)
        )
    except NoController as fault:
        raise NoController(
            f"gamma: {target_gamma:g} cannot be reached; allowed: at least {gamma_opt:.6g}. {fault}"
        ) from None
    loop = plant.close_loop(controller)
    achieved = hinf_norm(loop).norm
    if not achieved <= 1.01 * target_gamma:
        raise NoController(
            f"the controller for γ = {target_gamma:.6g} reaches only γ = {achieved:.6g}, because of rounding errors; "
            "use a larger synthesis.backoff_percent, or weights with corner frequencies closer together"
        )
    return Hinf(controller, target_gamma, gamma_opt, achieved, limiting)


def smallest_gamma(normal: NormalForm, tolerance: float = 1e-7) -> tuple[float, str]:
    """Return γ_opt (from above, to `tolerance` of it) and, as text, the condition that fails just below.

    Raises NoController if no γ up to LARGEST_GAMMA can be reached.
    """
    low = high = max(_direct_bound(normal), 1e-6)
    limiting = "the direct part D11, which no controller changes"
    while (fault := _failing_condition(normal, high * (1 + tolerance))) is not None:
        low, high, limiting = high, 2 * high, fault
        if high > LARGEST_GAMMA:
            raise NoController(f"no controller up to γ = {LARGEST_GAMMA:g}: {limiting}")
    while high - low > tolerance * high:
        middle = math.sqrt(low * high)
        fault = _failing_condition(normal, middle)
        low, high, limiting = (low, middle, limiting) if fault is None else (middle, high, fault)
    return high * (1 + tolerance), limiting


def _failing_condition(normal: NormalForm, gamma: float) -> str | None:
    """Return, as text, the condition that fails at γ; None if none does."""
    try:
        _solve_riccati_pair(normal, gamma)
    except NoController as fault:
        return str(fault)
    return None


def _direct_bound(normal: NormalForm) -> float:
    """Return a lower bound on γ from the rows and columns of D11 that no controller changes: the larger of their
    norms.
    """
    rows, columns = normal.d11.shape[0] - normal.b2.shape[1], normal.d11.shape[1] - normal.c2.shape[0]
    parts = normal.d11[:rows], normal.d11[:, :columns]
    return max(float(np.linalg.norm(part, 2)) if part.size else 0.0 for part in parts)


def _solve_riccati_pair(normal: NormalForm, gamma: float) -> _Solutions:
    """Solve both Riccati equations and check their coupling; return X∞, Y∞ and the gains F and L that follow.

    Raises NoController if γ does not exceed `_direct_bound`, an equation has no solution ≥ 0, or ρ(XY) ≥ γ².
    """
    if gamma <= (bound := _direct_bound(normal)):
        raise NoController(
            f"γ = {gamma:.6g}; allowed: above {bound:.6g}, the norm of the part of D11 that no controller changes"
        )
    a, b1, b2, c1, c2, d11, d12, d21 = normal.matrices
    b, d_row = np.hstack([b1, b2]), np.hstack([d11, d12])
    c, d_column = np.vstack([c1, c2]), np.vstack([d11, d21])
    r = d_row.T @ d_row - _gamma_corner(gamma, b1.shape[1], b.shape[1])
    r_dual = d_column @ d_column.T - _gamma_corner(gamma, c1.shape[0], c.shape[0])
    x = _solve_riccati("state feedback, X∞", a, b, c1, d_row, r)
    y = _solve_riccati("estimation, Y∞", a.T, c.T, b1.T, d_column.T, r_dual)
    radius = float(np.max(np.abs(np.linalg.eigvals(x @ y)), initial=0.0))
    if not radius < gamma**2:
        raise NoController(
            f"coupling: the spectral radius of X∞·Y∞ is {radius:.6g}; allowed: below γ² = {gamma**2:.6g}"
        )
    f = -np.linalg.solve(r, d_row.T @ c1 + b.T @ x)
    injection = -np.linalg.solve(r_dual.T, (b1 @ d_column.T + y @ c.T).T).T
    return _Solutions(x, y, np.asarray(f, float), np.asarray(injection, float))


def _gamma_corner(gamma: float, count: int, size: int) -> Real:
    """Return zeros (size, size) with γ² on the first `count` diagonal elements."""
    corner = np.zeros((size, size))
    corner[:count, :count] = gamma**2 * np.eye(count)
    return corner


_FAULT_TEXTS: dict[Fault, str] = {
    "imaginary axis": "its Hamiltonian matrix has eigenvalues on the imaginary axis",
    "no graph": "the stable subspace of its Hamiltonian matrix gives no solution",
    "indefinite": "its solution is not positive semidefinite",
}


def _solve_riccati(name: str, a: Real, b: Real, c1: Real, d: Real, r: Real) -> Real:
    """Return X∞ of [A 0; −C1ᵀC1 −Aᵀ] − [B; −C1ᵀD] R⁻¹ [DᵀC1  Bᵀ]; Y∞ for transposed arguments.

    Raises NoController, with `name` and the reason, if there is no solution ≥ 0.
    """
    n = a.shape[0]
    left_factor, right_factor = np.vstack([b, -c1.T @ d]), np.hstack([d.T @ c1, b.T])
    hamiltonian = np.block([[a, np.zeros((n, n))], [-c1.T @ c1, -a.T]]) - left_factor @ np.linalg.solve(r, right_factor)
    try:
        return stabilising_solution(hamiltonian)
    except NoSolution as error:
        raise NoController(f"Riccati equation of the {name}: {_FAULT_TEXTS[error.fault]}") from None


def _central_controller(normal: NormalForm, solutions: _Solutions, gamma: float) -> Matrices:
    """Return the central controller (Q = 0) of theorem 17.1, for D12 = [0; I], D21 = [0 I], D22 = 0."""
    a, b1, b2, _, c2, d11, _, _ = normal.matrices
    x, y, f, injection = solutions
    m2, p2 = b2.shape[1], c2.shape[0]
    rows, columns = d11.shape[0] - m2, d11.shape[1] - p2
    d1111, d1112, d1121, d1122 = d11[:rows, :columns], d11[:rows, columns:], d11[rows:, :columns], d11[rows:, columns:]
    outer = np.linalg.inv(gamma**2 * np.eye(rows) - d1111 @ d1111.T)
    inner = np.linalg.inv(gamma**2 * np.eye(columns) - d1111.T @ d1111)
    direct = -d1121 @ d1111.T @ outer @ d1112 - d1122
    d12 = np.real(sqrtm(np.eye(m2) - d1121 @ inner @ d1121.T))
    d21 = np.real(sqrtm(np.eye(p2) - d1112.T @ outer @ d1112))
    f12, f2 = f[columns : columns + p2], f[columns + p2 :]
    l12, l2 = injection[:, rows : rows + m2], injection[:, rows + m2 :]
    z = np.linalg.inv(np.eye(a.shape[0]) - y @ x / gamma**2)
    input_2, output_2 = z @ (b2 + l12) @ d12, -d21 @ (c2 + f12)
    input_y = -z @ l2 + input_2 @ np.linalg.solve(d12, direct)
    output_y = np.linalg.solve(d21, output_2)
    return Matrices(a + np.hstack([b1, b2]) @ f + input_y @ output_y, input_y, f2 + direct @ output_y, direct)
