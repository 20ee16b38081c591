"""Stated standard deviations of figures, compared with the spread of these figures over draws of known distribution."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from rtloop.analysis.measured.loop import MeasuredLoop
from rtloop.analysis.measured.margins import measured_margins
from rtloop.design.identification.hysteresis.judgement import combine_errors

DRAWS = 1000
CHANCE = 1e-6
"""Probability that a correct standard deviation is refused."""


def require_stated(stated: float, values: np.ndarray, bias: float) -> None:
    """Fail unless normally distributed `values` spread as stated, apart from CHANCE and a relative `bias`."""
    freedom = values.size - 1
    low, high = np.sqrt(stats.chi2.ppf([CHANCE / 2, 1 - CHANCE / 2], freedom) / freedom)
    ratio = values.std(ddof=1) / stated
    assert low * (1 - bias) < ratio < high * (1 + bias), f"stated {stated:.4g}, the spread is {ratio:.3f} of it"


def test_the_error_of_several_recordings_spreads_as_stated():
    """Thirty recordings have 20 normal errors each; the stated variance is correct in the mean."""
    errors_um = np.random.default_rng(1).normal(0.0, 0.3, (DRAWS, 30, 20))
    rms_um = np.sqrt(np.mean(errors_um**2, axis=2))
    combined = [combine_errors(row.tolist()) for row in rms_um]
    stated = np.sqrt(np.mean([error.std_um**2 for error in combined]))
    assert stated == pytest.approx(0.3 / np.sqrt(2 * 30 * 20), rel=0.02)  # σ/√(2n), of n normal errors
    require_stated(stated, np.array([error.rms_um for error in combined]), bias=0.02)


def test_margins_of_a_measured_loop_spread_as_stated():
    """L = 2/(s + 1)³, known to 2 % of its magnitude: every draw moves all of it by one complex number."""
    hz, spread = np.geomspace(0.05, 0.6, 60), 0.02
    loop = 2 / (2j * np.pi * hz + 1) ** 3
    stated = measured_margins(MeasuredLoop(hz, loop, np.full(hz.size, spread), 1e4, None))
    dense_loop = 2 / (2j * np.pi * np.geomspace(0.05, 0.6, 4000) + 1) ** 3
    parts = np.random.default_rng(2).normal(0.0, spread * np.sqrt(0.5), (DRAWS, 2))
    modulus = np.array([np.abs(1 + dense_loop * (1 + complex(*part))).min() for part in parts])
    assert stated.modulus_margin.value == pytest.approx(np.abs(1 + dense_loop).min(), rel=1e-4)
    require_stated(stated.modulus_margin.std, modulus, bias=0.02)
    require_stated(stated.max_sensitivity.std, 1 / modulus, bias=0.02)
