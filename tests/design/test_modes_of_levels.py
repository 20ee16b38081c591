"""Wrong levels of the input, and creep that the recording hardly shows, make no mode; true slow modes stay.

The recordings are made by scipy alone: a resonance of 310 Hz that rings until the end of each level.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from rtloop.design.identification.dynamics.dynamics_fit import DynamicsFit
from rtloop.design.identification.dynamics.identify_in_loop import identify_recorded_dynamics
from rtloop.design.identification.dynamics.prediction_error import Excitation
from rtloop.foundation.arrays import Real

PERIOD_S, SAMPLES = 1e-4, 10_000
OMEGA = 2 * np.pi * 310


def response(u: Real, numerator: list[float], denominator: list[float]) -> Real:
    """Return the response (samples,) to a held input, from rest."""
    discrete: Any = cont2discrete((numerator, denominator), PERIOD_S)
    return np.asarray(lfilter(np.ravel(discrete[0]), discrete[1], u), float)


def identify(errors_um: tuple[float, float], slow_hz: float, slow_share: float, noise_um: float) -> DynamicsFit:
    """Identify a second of a step to 40 and to 22 µm, whose levels miss `errors_um`, from a resonance and a real pole
    at `slow_hz` that has `slow_share` of the gain.
    """
    k, rate = np.arange(SAMPLES), 2 * np.pi * slow_hz
    levels_um = 40.0 * (k >= 1000) - 18.0 * (k >= 5500)
    true_um = levels_um + errors_um[0] * (k >= 1000) + (errors_um[1] - errors_um[0]) * (k >= 5500)
    position_um = (1 - slow_share) * response(true_um, [OMEGA**2], [1, 2 * 0.012 * OMEGA, OMEGA**2])
    position_um += slow_share * response(true_um, [rate], [1, rate])
    position_um += noise_um * np.random.default_rng(3).standard_normal(SAMPLES)
    return identify_recorded_dynamics(Excitation("step.mcap", levels_um, position_um, PERIOD_S))


@pytest.mark.parametrize("errors_um", [(0.1, 0.25), (-0.1, -0.25)])
def test_wrong_levels_make_no_mode_while_the_stage_rings(errors_um: tuple[float, float]) -> None:
    fit = identify(errors_um, 1.0, 0.0, 0.003)
    (mode,) = fit.modes
    assert mode.frequency_hz == pytest.approx(310, abs=1e-3)
    assert mode.damping == pytest.approx(0.012, rel=1e-4)
    # The gain is that of the first step, (40 + e)/40; the second level is then wrong by the rest.
    assert fit.static_gain == pytest.approx(1 + errors_um[0] / 40, rel=1e-4)
    assert fit.level_correction == pytest.approx(abs((22 + errors_um[1]) / fit.static_gain - 22), rel=1e-2)
    assert fit.transfer.zeros.size == 0  # noise alone puts a zero far beyond the Nyquist rate


@pytest.mark.parametrize(("slow_hz", "slow_share"), [(5.0, 0.02), (0.5, 0.03)])
def test_a_true_slow_mode_stays_beside_wrong_levels(slow_hz: float, slow_share: float) -> None:
    fit = identify((0.1, 0.25), slow_hz, slow_share, 0.003)
    slow, fast = fit.modes
    assert slow.frequency_hz == pytest.approx(slow_hz, rel=0.01)
    assert slow.static_share == pytest.approx(slow_share, rel=0.02)
    assert fast.frequency_hz == pytest.approx(310, abs=1e-2)
    assert not fit.left_out_hz


def test_creep_that_the_recording_hardly_shows_is_left_out() -> None:
    fit = identify((0.0, 0.0), 0.3, 0.001, 0.03)
    (mode,) = fit.modes
    assert mode.frequency_hz == pytest.approx(310, abs=0.1)
    assert all(hz < 1 for hz in fit.left_out_hz)
