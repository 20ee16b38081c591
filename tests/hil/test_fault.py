"""Simulated faults of sensor and drive, compared with a healthy rig."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.hil.options import FaultOptions, PlantOptions, RigOptions, SensorOptions
from rtloop.hil.rig import advance, build_rig, sample

PERIOD_S, START = 1e-4, 40
KINDS = ("none", "sensor_stuck", "sensor_lost", "drive_lost")


def readings_v(kind: str, start_s: float = START * PERIOD_S, drive_v: float = 3.0) -> np.ndarray:
    """Return 200 readings and true positions of a rig without noise at a constant drive, (200, 2)."""
    plant = PlantOptions(sensor=SensorOptions(noise_um=0.0), fault=FaultOptions(kind=kind, start_s=start_s))
    coefficients, state = build_rig(RigOptions(plant=plant), ["x"], PERIOD_S)
    rows = []
    for _ in range(200):
        reading_v = sample(coefficients[0], state[0])
        rows.append((reading_v, state[0].true_position_um))
        advance(coefficients, state, np.array([drive_v]))
    return np.array(rows)


@pytest.mark.parametrize("kind", KINDS)
def test_before_its_time_a_fault_changes_nothing(kind):
    assert np.array_equal(readings_v(kind)[:START], readings_v("none")[:START])


def test_a_stuck_reading_stands_still_while_the_rig_moves():
    healthy, stuck = readings_v("none"), readings_v("sensor_stuck")
    assert np.all(stuck[START:, 0] == healthy[START - 1, 0])
    assert np.array_equal(stuck[:, 1], healthy[:, 1])


def test_a_lost_reading_is_0_v_while_the_rig_moves():
    healthy, lost = readings_v("none"), readings_v("sensor_lost")
    assert np.all(lost[START:, 0] == 0.0)
    assert np.array_equal(lost[:, 1], healthy[:, 1])


def test_a_lost_drive_leaves_the_actuator_at_0_v():
    """The rig without voltage from period 40 on moves as one whose drive is written as 0 V from then on."""
    plant = PlantOptions(sensor=SensorOptions(noise_um=0.0))
    coefficients, state = build_rig(RigOptions(plant=plant), ["x"], PERIOD_S)
    expected = []
    for number in range(200):
        expected.append((sample(coefficients[0], state[0]), state[0].true_position_um))
        advance(coefficients, state, np.array([3.0 if number < START else 0.0]))
    assert np.array_equal(readings_v("drive_lost"), np.array(expected))
