"""Dynamics from recordings that begin in motion or at rest: free motion is reported only where the plant has it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from rtloop.design.identification.dynamics.identify_dynamics import identify_dynamics
from rtloop.design.identification.dynamics.prediction_error import Excitation

RATE_HZ, HZ, ZETA, GAIN, NOISE_UM = 20_000.0, 1150.0, 0.03, 3.2, 0.004


def recording(samples: int, skipped: int) -> Excitation:
    """Return a random drive (V) and its position behind GAIN ω²/(s² + 2ζω s + ω²), without `skipped` first ticks."""
    rng = np.random.default_rng(3)
    drive_v = np.repeat(rng.uniform(-0.5, 0.5, (samples + skipped) // 2), 2)
    omega = 2 * np.pi * HZ
    a, b = np.array([[0.0, 1.0], [-(omega**2), -2 * ZETA * omega]]), np.array([[0.0], [omega**2]])
    plant = (a, b, np.array([[1.0, 0.0]]), np.zeros((1, 1)))
    a, b, *_ = signal.cont2discrete(plant, 1 / RATE_HZ, "zoh")
    state, position_um = np.zeros(2), np.empty(drive_v.size)
    for k, drive in enumerate(drive_v):
        position_um[k] = GAIN * state[0]
        state = a @ state + b[:, 0] * drive
    position_um += rng.normal(0.0, NOISE_UM, position_um.size)
    return Excitation("x", drive_v[skipped:], position_um[skipped:], 1 / RATE_HZ)


@pytest.mark.parametrize("skipped", [0, 1, 400])
def test_a_recording_that_begins_in_motion_gives_the_same_model(skipped: int) -> None:
    """The rms prediction error is the noise, whatever motion the recording begins with."""
    fit = identify_dynamics(recording(8000, skipped), order=2, delay_ticks=0)
    (mode,) = fit.modes
    assert mode.frequency_hz == pytest.approx(HZ, abs=5 * mode.frequency_std_hz)
    assert mode.frequency_std_hz < 0.01
    assert fit.static_gain == pytest.approx(GAIN, rel=1e-3)
    assert fit.rms_error_um == pytest.approx(NOISE_UM, rel=0.03)
    assert (fit.free_motion_s > 0) == (skipped > 0)
    decay_s = 1 / (ZETA * 2 * np.pi * HZ)
    assert fit.free_motion_s < 15 * decay_s
    assert fit.tests.is_white
    assert fit.tests.is_independent


def test_an_outlier_behind_the_beginning_is_no_free_motion() -> None:
    run = recording(4000, 0)
    run.position_um[60] += 0.3
    assert identify_dynamics(run, order=2, delay_ticks=0).free_motion_s == 0.0
