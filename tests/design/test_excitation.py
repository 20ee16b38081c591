"""Peak of the first excitation period, and motion, command and reference of a period fitted to a known response."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.analysis.measured.excitation import first_period, fit_period
from rtloop.analysis.measured.multisine import make_grid
from tests.design.measured_loops import RATE_HZ

GRID = make_grid(RATE_HZ, 0.25, 4.0, 2000.0)


def test_the_first_period_is_so_small_that_a_loop_may_amplify_it_fivefold() -> None:
    assert np.abs(first_period(GRID, 3.0)).max() == pytest.approx(3.0 / 5)


def test_a_fitted_period_moves_a_plain_gain_by_three_quarters_of_the_amplitude() -> None:
    gain = np.full(GRID.excited.size, 0.8 + 0j)
    assert np.abs(0.8 * fit_period(GRID, gain, 0.1 * gain, 3.0)).max() == pytest.approx(0.75 * 3.0, rel=1e-6)


def test_a_fitted_period_keeps_command_and_reference_within_their_limits() -> None:
    """At a gain of 0.01 the full motion would need a reference of 75 times the amplitude; the limits are 10 and 3."""
    gain = np.full(GRID.excited.size, 0.01 + 0j)
    assert np.abs(fit_period(GRID, gain, 0.1 * gain, 1.0)).max() == pytest.approx(10.0, rel=1e-6)
    command = np.full(GRID.excited.size, 1.0 + 0j)
    assert np.abs(fit_period(GRID, gain, command, 1.0)).max() == pytest.approx(3.0, rel=1e-6)
