"""Functions of small real matrices for predictions about a loop.

They import numpy alone. `scipy.linalg` takes a tenth of a second of import, which every command and every service would
spend at its start. The coefficients of a controller come from scipy's functions (`holds`, `antiwindup`): they must keep
every bit, so that a replay of an old recording stays equal.
"""

from __future__ import annotations

import math
from itertools import accumulate

import numpy as np

from rtloop.foundation.arrays import Real

PADE_ORDER = 13
PADE_COEFFICIENTS = tuple(
    accumulate(
        range(1, PADE_ORDER + 1),
        lambda last, j: last * (PADE_ORDER - j + 1) / ((2 * PADE_ORDER - j + 1) * j),
        initial=1.0,
    )
)
"""Coefficients of the numerator of the Padé approximant of eˣ, lowest power first."""
LARGEST_SCALED_NORM = 4.25
"""Norm up to which the approximant is exact to rounding (θ₁₃ of Al-Mohy & Higham 2009)."""
MAX_DOUBLINGS = 64


def matrix_exponential(matrix: Real) -> Real:
    """Return the exponential of a real matrix (n, n), by scaling and squaring a Padé approximant of order 13.

    Higham, SIAM J. Matrix Anal. Appl. 26 (2005). The scale follows from the norms of powers, not from the norm of
    the matrix (Al-Mohy & Higham, SIAM J. Matrix Anal. Appl. 31, 2009): in [A B; 0 0] a large B needs no squaring.
    """
    size = _one_norm(matrix)
    unit = matrix / size if size > 0 else matrix  # Powers of the matrix itself may overflow.
    square = unit @ unit
    fourth = square @ square
    sixth = fourth @ square
    norm = size * max(_one_norm(fourth) ** (1 / 4), _one_norm(sixth) ** (1 / 6))
    squarings = max(0, math.ceil(math.log2(norm / LARGEST_SCALED_NORM))) if norm > 0 else 0
    scale = size * 2.0**-squarings
    first, even = unit * scale, (np.eye(matrix.shape[0]), square * scale**2, fourth * scale**4, sixth * scale**6)
    odd_part = first @ _pade_sum(PADE_COEFFICIENTS[1::2], even)
    even_part = _pade_sum(PADE_COEFFICIENTS[::2], even)
    exponential = np.linalg.solve(even_part - odd_part, even_part + odd_part)
    for _ in range(squarings):
        exponential = exponential @ exponential
    return np.asarray(exponential, dtype=np.float64)


def stationary_covariance(a: Real, driving: Real) -> Real:
    """Return X (n, n) = A X Aᵀ + `driving` for a stable A and a positive semidefinite `driving`, both (n, n).

    X is the sum of A^k `driving` A^kᵀ; the number of terms is doubled until the sum no longer changes (Smith 1968). For
    an A with an eigenvalue outside the unit circle the result is meaningless, and may be infinite.
    """
    covariance, power = driving, a
    for _ in range(MAX_DOUBLINGS):
        addition = power @ covariance @ power.T
        covariance = covariance + addition
        if not np.abs(addition).max(initial=0.0) > 1e-17 * np.abs(covariance).max(initial=0.0):
            break
        power = power @ power
    return covariance


def block_diagonal(matrices: list[Real]) -> Real:
    """Return the square `matrices` along the diagonal of one matrix; 0 elsewhere."""
    joint, row = np.zeros((size := sum(matrix.shape[0] for matrix in matrices), size)), 0
    for matrix in matrices:
        end = row + matrix.shape[0]
        joint[row:end, row:end] = matrix
        row = end
    return joint


def _one_norm(matrix: Real) -> float:
    """Return the largest sum of magnitudes of a column; 0 for an empty matrix."""
    return float(np.abs(matrix).sum(axis=0).max(initial=0.0))


def _pade_sum(coefficients: tuple[float, ...], even_powers: tuple[Real, Real, Real, Real]) -> Real:
    """Return Σ c_i X^2i for seven `coefficients`, from the powers (1, X², X⁴, X⁶)."""
    high = sum(c * power for c, power in zip(coefficients[4:], even_powers[1:], strict=True))
    low = sum(c * power for c, power in zip(coefficients[:4], even_powers, strict=True))
    return np.asarray(even_powers[3] @ high + low)
