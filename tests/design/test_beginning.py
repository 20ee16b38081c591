"""Recordings in open loop that begin at a bias, in motion, or on a drifting stage, simulated by scipy."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim

from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.identification.dynamics.beginning import refer_to_beginning, without_drift
from rtloop.design.identification.dynamics.excitation import LoopExcitation
from rtloop.design.identification.dynamics.identify_in_loop import identify_recorded_dynamics
from rtloop.design.identification.dynamics.prediction_error import Excitation

PERIOD_S, GAIN, HZ, DAMPING, NOISE_UM = 1e-4, 1.5, 400.0, 0.03, 1e-3
REST, SAMPLES = 300, 3000


def stage_position(drive_v: np.ndarray) -> np.ndarray:
    """Return the position in µm of a mode of 400 Hz that has rested at the first drive."""
    w = 2 * np.pi * HZ
    a, b = np.array([[0, 1], [-w * w, -2 * DAMPING * w]]), np.array([[0], [GAIN * w * w]])
    _, position, _ = dlsim(cont2discrete((a, b, np.eye(2)[:1], np.zeros((1, 1))), PERIOD_S), drive_v - drive_v[0])
    return position[:, 0] + GAIN * drive_v[0]


def record(bias_v: float, *, skip: int = 0, drift_um: float = 0.0, sign: float = 1.0, seed: int = 4) -> Excitation:
    """Return ±1 V at random about a bias after a rest, without the first `skip` samples."""
    rng = np.random.default_rng(seed)
    drive = bias_v + np.repeat(rng.choice([-1.0, 1.0], SAMPLES // 4), 4)
    drive[:REST] = bias_v
    position = sign * stage_position(drive) + 7.0 + drift_um * np.linspace(0, 1, SAMPLES)
    position += NOISE_UM * rng.standard_normal(SAMPLES)
    return Excitation("drawn", drive[skip:], position[skip:], PERIOD_S)


def assert_right(run: Excitation) -> None:
    fit = identify_recorded_dynamics(run)
    light = min(fit.modes, key=lambda mode: mode.damping if mode.static_share > 0.1 else 1.0)
    assert fit.static_gain == pytest.approx(GAIN, rel=1e-3)
    assert light.frequency_hz == pytest.approx(HZ, rel=1e-4)
    assert light.damping == pytest.approx(DAMPING, rel=1e-2)


@pytest.mark.parametrize("skip", [0, REST + 123])
@pytest.mark.parametrize("bias_v", [0.0, 5.0, -40.0])
def test_a_bias_does_not_change_the_model(bias_v: float, skip: int) -> None:
    assert_right(refer_to_beginning(record(bias_v, skip=skip), begins_at_0=False))


def test_a_recording_that_begins_with_a_step_from_0_stays_as_it_is() -> None:
    drive = np.full(SAMPLES, 5.0)
    run = Excitation("step", drive, stage_position(np.insert(drive, 0, 0.0))[:-1], PERIOD_S)
    assert refer_to_beginning(run, begins_at_0=True) is run
    assert isinstance(refer_to_beginning(run, begins_at_0=False), LoopExcitation)


def test_a_drifting_stage_is_refused_and_identified_without_its_drift() -> None:
    for drift_um, reason in (
        (3.0, "static gain is uncertain|explains .* % of the motion"),
        (-40.0, "drifts by -40 µm"),
    ):
        run = record(5.0, drift_um=drift_um)
        with pytest.raises(UnsuitableData, match=f"({reason}).*--detrend"):
            identify_recorded_dynamics(refer_to_beginning(run, begins_at_0=False))
        assert_right(without_drift(run))


def test_a_drive_that_does_not_move_the_stage_gives_no_model_and_no_verdict_about_its_sign() -> None:
    run, other = record(5.0), record(5.0, seed=5)
    unrelated = Excitation("unrelated", other.input, run.position_um, PERIOD_S)
    with pytest.raises(UnsuitableData, match=r"static gain is uncertain|explains .* % of the motion"):
        identify_recorded_dynamics(refer_to_beginning(unrelated, begins_at_0=False))


@pytest.mark.parametrize("skip", [0, REST + 123])
def test_a_stage_at_a_bias_that_moves_against_its_drive_is_named(skip: int) -> None:
    with pytest.raises(UnsuitableData, match=r"sign of drive or position is wrong: .* by 1\.5"):
        identify_recorded_dynamics(refer_to_beginning(record(5.0, skip=skip, sign=-1.0), begins_at_0=False))
