"""Zeros and gain of a state space with one input and one output, and the response of zeros, poles and gain."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Complex, Real
from rtloop.linear.realisation import System

LEAST_RATIO, POINTS, LEAST_DISTANCE = 1e3, 25, 0.02
"""Least response beside the direct gain, number of points tried, and their least distance from a pole, of the point."""
NOWHERE, SAME_GAIN = 1e-12, 1e-6
"""Zeros beyond the largest pole divided by the first are at infinity; gains that agree to the second are the same."""


def zeros_and_gain(system: System) -> tuple[Complex, float]:
    """Return the finite zeros (m,) of c(xI − A)⁻¹b + d and its gain, the factor of Π(x − zᵢ)/Π(x − pᵢ).

    A system that is zero has no zeros and the gain 0.

    Zeros at infinity are removed one at a time (Emami-Naeini & Van Dooren, Automatica 18, 1982, for one input and one
    output): a reflection turns b into (β, 0, …, 0); while d = 0, the first state is the input of the other states, and
    β is a factor of the gain. Once d ≠ 0, the zeros are the generalised eigenvalues of [A b; c d] and [I 0; 0 0], which
    are the eigenvalues of A − b c/d. Beside a response far above d, these lose their digits; they are then found
    from the reciprocals 1/(x − x₀), whose system has the direct gain G(x₀) (`_zeros_around`).
    """
    a, b, c, d = _balanced(system)
    gain = 1.0
    noise = 1e-15 * float(np.linalg.norm(b) * np.linalg.norm(c) / max(np.linalg.norm(a), 1e-300))
    while abs(d) <= noise and b.size:
        mirror, beta = _reflection(b)
        a, c = mirror @ a @ mirror, c @ mirror
        noise = 1e-13 * float(np.linalg.norm(c))
        gain *= beta
        a, b, c, d = a[1:, 1:], a[1:, 0], c[1:], float(c[0])
    if abs(d) <= noise or gain == 0:
        return np.empty(0, dtype=complex), 0.0
    if (around := _zeros_around(System(a, b, c, d))) is not None:
        return around[0], gain * around[1]
    return np.linalg.eigvals(a - np.outer(b, c) / d).astype(complex), gain * d


def factored_response(zeros: Complex, poles: Complex, gain: float, complex_points: npt.ArrayLike) -> Complex:
    """Return gain·Π(x − z)/Π(x − p) at complex points, in their shape, one ratio at a time to avoid overflow."""
    points = np.asarray(complex_points, dtype=complex)
    value = np.full(points.shape, complex(gain))
    for i, pole in enumerate(poles):
        value *= (points - zeros[i] if i < zeros.size else 1.0) / (points - pole)
    for zero in zeros[poles.size :]:
        value *= points - zero
    return value


def _zeros_around(system: System) -> tuple[Complex, float] | None:
    """Return zeros and gain of a system from its response at the real point x₀ where this is largest.

    None if no response, at a point away from all poles, is above LEAST_RATIO times the direct gain. With
    N = (A − x₀ I)⁻¹, the zeros are x₀ + 1/w for the eigenvalues w of N + N b c N/G(x₀); one without a reciprocal is at
    infinity. The gain makes the response at x₀ exact, or is d if the least known zero, the farthest, can do so.
    """
    a, b, c, d = system
    if not b.size:
        return None
    poles = np.linalg.eigvals(a).astype(complex)
    sizes = np.abs(poles[poles != 0])
    points = np.append(0.0, np.geomspace(sizes.min(), 2 * sizes.max(), POINTS) if sizes.size else [])
    distances = np.abs(points[:, None] - poles).min(axis=1) - LEAST_DISTANCE * points
    responses = {float(point): _response(system, point) for point in points[distances > 0]}
    point, value = max(responses.items(), key=lambda item: abs(item[1]), default=(0.0, 0.0))
    if abs(value) <= LEAST_RATIO * abs(d):
        return None
    inverse = np.linalg.inv(a - point * np.eye(b.size))
    reciprocals = np.linalg.eigvals(inverse + np.outer(inverse @ b, c @ inverse) / value)
    finite = np.abs(reciprocals) * sizes.max(initial=0.0) > NOWHERE
    zeros = (point + 1 / reciprocals[finite]).astype(complex)
    gain = value / factored_response(zeros, poles, 1.0, point).real
    if zeros.size == poles.size and abs(gain / d - 1) < SAME_GAIN:
        farthest = np.abs(zeros - point) >= (1 - 1e-9) * np.abs(zeros - point).max()
        zeros[farthest] = point + (zeros[farthest] - point) * (gain / d) ** (1 / farthest.sum())
        gain = d
    return zeros, float(gain)


def _response(system: System, point: float) -> float:
    """Return the response of a system at a real point."""
    a, b, c, d = system
    return float(d - c @ np.linalg.solve(a - point * np.eye(b.size), b))


def _reflection(vector: Real) -> tuple[Real, float]:
    """Return the symmetric Householder reflection (n, n) that turns `vector` (n,) into (β, 0, …, 0), and β =
    ±|vector|.
    """
    beta = -float(np.copysign(np.linalg.norm(vector), vector[0]))
    normal = vector - beta * np.eye(vector.size)[0]
    length = float(normal @ normal)
    return np.eye(vector.size) - (2 / length if length else 0.0) * np.outer(normal, normal), beta


def _balanced(system: System) -> System:
    """Return the system balanced by powers of two: each state's row and column get similar norms (Osborne 1960)."""
    a, b, c = system.a.copy(), system.b.copy(), system.c.copy()
    for _ in range(20):
        is_balanced = True
        for i in range(b.size):
            column = np.abs(np.delete(a[:, i], i)).sum() + abs(c[i])
            row = np.abs(np.delete(a[i], i)).sum() + abs(b[i])
            factor = 2.0 ** np.round(0.5 * np.log2(row / column)) if row > 0 and column > 0 else 1.0
            is_balanced = is_balanced and factor == 1.0
            a[:, i], c[i] = a[:, i] * factor, c[i] * factor
            a[i], b[i] = a[i] / factor, b[i] / factor
        if is_balanced:
            break
    return System(a, b, c, system.d)
