"""Tests of a fit's residuals: whiteness, and independence of the input.

    Q = N (N + 2) Σ r_k²/(N − k)     ~ χ²(lags − unknowns of the noise model)            Ljung & Box 1978
    √N r_εu(k)                       ~ N(0, Σ_j r_ε(j) r_u(j)), 99 % for all lags together      Ljung 1999, section 16.6

Both are strict: with many samples of little noise they find traces that no controller would notice. The sizes say more
than the verdicts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, norm

from rtloop.foundation.arrays import Real

LAGS = 25
LEVEL = 0.99
LARGEST_CROSS_RATIO = 3.0
"""Cross-correlation with the input, over its bound, from which on a model lacks a part of the dynamics."""


@dataclass(frozen=True)
class ResidualTests:
    """Largest autocorrelation (fraction of the variance), Q over its bound, largest cross-correlation (fraction), and
    the same over its bound; a ratio above 1 fails its test.
    """

    largest_autocorrelation: float
    whiteness_ratio: float
    largest_cross_correlation: float
    cross_ratio: float

    @property
    def is_white(self) -> bool:
        """Whether the errors pass the test of whiteness: they do not predict each other."""
        return self.whiteness_ratio <= 1

    @property
    def is_independent(self) -> bool:
        """Whether the errors pass the test of independence: they do not follow from the past input."""
        return self.cross_ratio <= 1


def residual_tests(u: Real, errors: Real, unknowns: int, lags: int = LAGS) -> ResidualTests:
    """Return two tests of prediction errors (N,), at lags 1 … `lags`: for whiteness (Ljung-Box), and for correlation
    with the changes of the input `u` (N,).

    The changes are used because a level that lasts correlates with any slow drift. `unknowns` is the number of the
    model's unknowns; a third of them, which the noise model has, lessens the degrees of freedom of the test for
    whiteness.
    """
    change = np.diff(u, prepend=0.0)
    autocorrelation, input_correlation = _correlations(errors, errors, lags), _correlations(change, change, lags)
    cross_correlation = _correlations(errors, change, lags)[1:] / np.sqrt(
        autocorrelation[0] * input_correlation[0] or 1.0
    )
    autocorrelation, input_correlation = (
        autocorrelation / (autocorrelation[0] or 1.0),
        input_correlation / (input_correlation[0] or 1.0),
    )
    n, k = errors.size, np.arange(1, lags + 1)
    ljung_box = n * (n + 2) * float(np.sum(autocorrelation[1:] ** 2 / (n - k)))
    variance = max(1.0 + 2 * float(autocorrelation[1:] @ input_correlation[1:]), 1e-3)
    bound = float(norm.ppf(1 - (1 - LEVEL) / (2 * lags))) * np.sqrt(variance / n)
    largest = float(np.abs(cross_correlation).max())
    limit = float(chi2.ppf(LEVEL, max(lags - unknowns // 3, 1)))
    return ResidualTests(float(np.abs(autocorrelation[1:]).max()), ljung_box / limit, largest, largest / bound)


def _correlations(a: Real, b: Real, lags: int) -> Real:
    """Return Σ a_k b_k−j for j = 0 … lags, (lags + 1,)."""
    return np.array([float(a[j:] @ b[: b.size - j]) for j in range(lags + 1)])
