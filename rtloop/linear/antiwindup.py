"""Anti-windup: the correction of a controller's states when a limit changes its output.

    v = c·x + d e        computed        x⁺ = A x + b e
    x ← x + m (v_applied − v)            before the states step on

With c·m = 1 the corrected states explain the applied output exactly: c·x + d e = v_applied. While the output is held
by a limit, the states obey x⁺ = A(I − m c)x + …, which must be stable.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.linear.realisation import Form, System, blocks


def antiwindup(system: System, form: Form) -> Real:
    """Return the anti-windup gain m (n,), by which a limited output corrects the states: x ← x + m (v_applied − v).

    m = W cᵀ/(c W cᵀ), for which c·m = 1 and A(I − m c) is stable; zeros if c is zero and A is stable.

    Proof, for the modal form: A consists of rotations scaled by |λ| ≤ 1, and W of one positive number per block, so
    that W^½ commutes with A. In the coordinates W^-½ x, A is still A, whose norm is the largest |λ|, and I − m c
    becomes I − q qᵀ with q = W^½ cᵀ/‖W^½ cᵀ‖: an orthogonal projection, of norm 1. The norm of the product, and with
    it the spectral radius, is at most the largest |λ|: below 1 for a stable controller, whatever the positive weights.

    The weight |β/(1 − λ)|² of a mode with input β is the square of the state's response to a constant input: slow
    modes take up most of a correction, and the choice does not depend on how the states are scaled. For an integrator
    it is infinite, so that it takes up all.

    If m is zero outside one set of blocks, before which c is zero and A is triangular, A(I − m c) stays triangular, and
    the argument is needed for that set only. The set has all unstable modes; without any, it is the last section of a
    cascade, or all modes of the modal form. For several unstable modes, W is the error covariance of a stationary
    Kalman filter that measures v almost without noise.

    Raises ValueError where the spectral radius is not below 1, and where no such filter exists.
    """
    correction = np.zeros(system.b.size)
    selected = _corrected_states(system, form)
    if selected.size == 0:
        return correction
    part = System(system.a[np.ix_(selected, selected)], system.b[selected], system.c[selected], system.d)
    spread = _weights(part) @ part.c
    if (weight := float(part.c @ spread)) > 0:
        correction[selected] = spread / weight
    radius = _spectral_radius(system.a - np.outer(system.a @ correction, system.c))
    if not radius < 1:
        raise ValueError(
            f"controller: unstable while its output is limited (largest |pole| {radius:.9g}); allowed: below 1"
        )
    return correction


def antiwindup_matrix(a: Real, b: Real, c: Real) -> Real:
    """Return the anti-windup gain M (n, m) of a controller with m outputs: x ← x + M (v_applied − v).

    C M = I, and A(I − M C) is stable; zeros if C is zero.

    M = W Cᵀ(C W Cᵀ)⁻¹ is the gain of an estimator that measures the outputs almost without noise, with W the error
    covariance of a stationary Kalman filter. If outputs are linearly dependent, C M = I holds in the least-squares
    sense. Raises ValueError if no such filter exists.
    """
    if a.shape[0] == 0 or not np.any(c):
        return np.zeros((a.shape[0], c.shape[0]))
    noise = 1e-9 * max(float(np.trace(c @ c.T)), 1e-300) * np.eye(c.shape[0])
    covariance = _covariance(a, c, b @ b.T + 1e-9 * np.trace(b @ b.T) * np.eye(a.shape[0]), noise)
    return covariance @ c.T @ np.linalg.pinv(c @ covariance @ c.T)


def tracking_share(a: Real, m: Real, c: Real, tracking_s: float, period_s: float) -> float:
    """Return 1 − exp(−T/`tracking_s`), the fraction of the correction applied per tick; 1 for a `tracking_s` of 0.

    `m` (n,) and `c` (n,), or (n, outputs) and (outputs, n): anti-windup gain and output matrix. Raises ValueError if
    the corrected states are unstable.
    """
    share = -math.expm1(-period_s / tracking_s) if tracking_s > 0 else 1.0
    outputs = c.size // max(a.shape[0], 1)
    radius = _spectral_radius(a - share * a @ m.reshape(-1, outputs) @ c.reshape(outputs, -1)) if a.size else 0.0
    if not radius < 1:
        raise ValueError(
            f"tracking_s: {tracking_s:g} s makes the controller unstable while the command is limited "
            f"(largest |pole| {radius:.6g}); use a smaller value, or 0"
        )
    return share


def steady_state_gain(system: System) -> Real:
    """Return (I − A)⁻¹ b (n,), the final states of a discrete-time system for a constant input of 1.

    A must be upper quasi-triangular, as `blocks` takes it. A block of one state with λ = 1 exactly integrates, and gets
    0.
    """
    resting = np.ones(system.b.size, dtype=bool)
    for block in blocks(system.a):
        resting[block] = block.stop - block.start == 2 or system.a[block.start, block.start] != 1.0
    gain = np.zeros(system.b.size)
    system_matrix = np.eye(int(resting.sum())) - system.a[np.ix_(resting, resting)]
    gain[resting] = np.linalg.solve(system_matrix, system.b[resting])
    return gain


def _corrected_states(system: System, form: Form) -> npt.NDArray[np.intp]:
    """Return the indices of the corrected states: all blocks with a |pole| ≥ 1. Without any: all modes of a modal form,
    the first block of a cascade that c sees, or none if c is zero.
    """
    states = np.arange(system.b.size)
    is_observable = np.abs(system.c) > 1e-9 * np.abs(system.c).max(initial=0.0)
    unstable_blocks = [block for block in blocks(system.a) if _spectral_radius(system.a[block, block]) >= 1]
    if unstable_blocks:
        return np.concatenate([states[block] for block in unstable_blocks])
    if form == "modal":
        return states if np.any(is_observable) else states[:0]
    return next((states[block] for block in blocks(system.a) if np.any(is_observable[block])), states[:0])


def _weights(part: System) -> Real:
    """Return W (n, n), positive definite, for `part`, the system of the corrected states alone.

    W is a Kalman error covariance for several blocks of which one has a |pole| ≥ 1, else a diagonal: |β/(1 − λ)|² for a
    block with input β and pole λ, 1 for a single block. Raises ValueError if c does not see every unstable mode.
    """
    diagonal_blocks = blocks(part.a)
    if len(diagonal_blocks) > 1 and any(_spectral_radius(part.a[block, block]) >= 1 for block in diagonal_blocks):
        noise = np.array([[1e-9 * float(part.c @ part.c)]])
        return _covariance(part.a, part.c[None, :], np.eye(part.b.size), noise)
    weights = np.empty(part.b.size)
    for block in diagonal_blocks:
        distance = abs(1 - np.linalg.eigvals(part.a[block, block])[0])
        weights[block] = np.sum(part.b[block] ** 2) / distance**2 if len(diagonal_blocks) > 1 else 1.0
        if block.stop - block.start == 2:  # A section close to a double pole is not an even rotation.
            weights[block.start + 1] *= -part.a[block.start + 1, block.start] / part.a[block.start, block.start + 1]
    return np.diag(np.maximum(weights, 1e-12 * weights.max()) if weights.max() > 0 else weights + 1)


def _covariance(a: Real, c: Real, driving: Real, noise: Real) -> Real:
    """Return W (n, n) = A W Aᵀ − A W Cᵀ(C W Cᵀ + noise)⁻¹C W Aᵀ + driving. Raises ValueError if there is none."""
    from scipy.linalg import solve_discrete_are  # a tenth of a second of import, for few controllers

    try:
        return solve_discrete_are(a.T, c.T, driving, noise)
    except (np.linalg.LinAlgError, ValueError):
        raise ValueError("controller: no anti-windup exists for its unstable modes; use a stable controller") from None


def _spectral_radius(a: Real) -> float:
    """Return the largest |eigenvalue| of `a`; 0 for an empty matrix."""
    return float(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0))
