"""Band in which a recording shows the dynamics, for a lag of 100 Hz under white noise, against its spectra by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from rtloop.design.identification.dynamics.excitation import LoopExcitation
from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.prediction_error import Excitation
from rtloop.design.identification.dynamics.visible_band import visible_hz

PERIOD_S, SAMPLES, LAG_HZ, NOISE_UM = 1e-4, 10_000, 100.0, 0.05
RATE = -2 * np.pi * LAG_HZ
FORGOTTEN = 1 - np.exp(RATE * PERIOD_S)
LAG = Innovations(PERIOD_S, np.array([RATE + 0j]), np.array([FORGOTTEN + 0j]), np.zeros(1, complex))
NOISE = NOISE_UM * np.random.default_rng(1).standard_normal(SAMPLES)


@pytest.mark.parametrize("step_um", [1.0, 10.0, -100.0])
def test_a_step_shows_a_lag_until_its_motion_is_below_the_noise(step_um: float) -> None:
    """Per tick, the step moves by |A|/√(1 + f²/100²), the noise by √N σ 2 sin(π f T)."""
    drive = np.where(np.arange(SAMPLES) < 1000, 0.0, step_um)
    position = lfilter([0.0, FORGOTTEN], [1.0, FORGOTTEN - 1], drive) + NOISE
    hz = np.linspace(1, 5000, 50_000)
    noise_um = np.sqrt(SAMPLES) * NOISE_UM * 2 * np.sin(np.pi * hz * PERIOD_S)
    crossing_hz = hz[np.flatnonzero(abs(step_um) / np.hypot(1, hz / LAG_HZ) > noise_um)[-1]]
    visible = visible_hz(LAG, Excitation("step", drive, position, PERIOD_S))
    assert crossing_hz / 2 ** (1 / 3) < visible < crossing_hz * 2 ** (1 / 3)


def test_fed_back_noise_shows_no_dynamics() -> None:
    """The reference moves at 5 Hz alone; a fast integrator feeds noise of all frequencies back to the command."""
    reference = 3.0 * np.sin(2 * np.pi * 5.0 * PERIOD_S * np.arange(SAMPLES))
    position, command = np.zeros(SAMPLES), np.zeros(SAMPLES)
    level = 0.0
    for k in range(1, SAMPLES):
        level += FORGOTTEN * (command[k - 1] - level)
        position[k] = level + 10 * NOISE[k]
        command[k] = command[k - 1] + 0.1 * (reference[k] - position[k])
    run = LoopExcitation("sine", command, position, PERIOD_S, reference[np.newaxis])
    assert 4.0 < visible_hz(LAG, run) < 50.0
    assert visible_hz(LAG, Excitation("sine", command, position, PERIOD_S)) > 100.0
