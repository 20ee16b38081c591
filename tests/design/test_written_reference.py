"""The reference of a designed configuration: an actuator, even with a one-sided drive, returns to both levels."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.configuration.axis import LimitsOptions
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
    far_um, near_um = steps_reference(limits, actuator, 800.0, 1e-4)["levels"]
    if sign > 0 or lowest_v < -2:  # on the other side, the level away from 0 may be out of reach
        assert low_um < far_um < high_um
    assert low_um <= near_um <= high_um
    assert 0.1 * command_um < abs(far_um - near_um) < 0.4 * command_um
    assert (near_um == 0.0) == (low_um <= 0.0 <= high_um)


def test_the_levels_last_for_fifty_periods_of_the_slowest_mode() -> None:
    actuator = PlayModel(np.array([0.0]), np.array([2.0]))
    values = steps_reference(LimitsOptions(command_um=37.6), actuator, 40.0, 1e-4)
    assert values == {"kind": "steps", "levels": [9.0, 0.0], "dwell_s": 1.25}
    assert describe_reference(values) == "steps between 9 and 0 µm, 1.25 s each"
