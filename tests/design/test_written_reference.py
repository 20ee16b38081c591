"""The reference of a designed configuration: an actuator, even with a one-sided drive, returns to both levels."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.configuration.axis import LimitsOptions
from rtloop.design.chain import dwell_s
from rtloop.design.identification.dynamics.dynamics_fit import Mode
from rtloop.design.written_reference import describe_reference, steps_reference
from rtloop.hysteresis.play_model import PlayModel

THRESHOLDS_V, WEIGHTS = (0.0, 1.0, 2.0, 4.0), (2.0, 0.8, 0.8, 0.8)


def cycle_ends_um(sign: float, lowest_v: float, highest_v: float) -> tuple[float, float]:
    """Return the lowest and highest position (µm) of a cycle between both drives, by plays stepped one by one."""
    outputs, ends = [0.0] * 4, []
    for drive in [highest_v, lowest_v, highest_v]:
        outputs = [max(drive - r, min(drive + r, z)) for r, z in zip(THRESHOLDS_V, outputs, strict=True)]
        ends.append(sign * sum(w * z for w, z in zip(WEIGHTS, outputs, strict=True)))
    return min(ends[1:]), max(ends[1:])


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("lowest_v", [0.0, -0.5, -2.0, -10.0])
def test_the_actuator_comes_back_to_both_levels(lowest_v: float, sign: float) -> None:
    low_um, high_um = cycle_ends_um(sign, lowest_v, 10.0)
    command_um = 0.9 * max(abs(low_um), abs(high_um))
    limits = LimitsOptions(drive_min_v=lowest_v, drive_v=10.0, command_um=command_um)
    actuator = PlayModel(np.array(THRESHOLDS_V), sign * np.array(WEIGHTS))
    far_um, near_um = steps_reference(limits, actuator, 0.0, 1e-4)["levels"]
    if sign > 0 or lowest_v < -2:  # on the other side, the level away from 0 may be out of reach
        assert low_um < far_um < high_um
    assert low_um <= near_um <= high_um
    assert 0.1 * command_um < abs(far_um - near_um) < 0.4 * command_um
    assert (near_um == 0.0) == (low_um <= 0.0 <= high_um)


def test_the_levels_last_until_the_modes_settle() -> None:
    actuator = PlayModel(np.array([0.0]), np.array([2.0]))
    values = steps_reference(LimitsOptions(command_um=37.6), actuator, 1.25, 1e-4)
    assert values == {"kind": "steps", "levels": [9.0, 0.0], "dwell_s": 1.25}
    assert describe_reference(values) == "steps between 9 and 0 µm, 1.25 s each"


@pytest.mark.parametrize(
    ("frequency_hz", "damping", "static_share", "expected_s"),
    [
        (40.0, 0.01, 1.0, 1.25),  # 50 periods
        (2.0, 1.0, 0.5, 0.3979),  # e^-5 of a real pole at -12.57 rad/s is left after 5/12.57 s
        (0.2, 1.0, 0.04, 0.0),  # creep
    ],
)
def test_a_level_lasts_fifty_periods_or_five_decay_times(
    frequency_hz: float, damping: float, static_share: float, expected_s: float
) -> None:
    mode = Mode(frequency_hz, 0.0, damping, 0.0, static_share)
    assert dwell_s([mode]) == pytest.approx(expected_s, rel=1e-3)
