"""The motion of a measurement stays within position interlock and sensor range, on both sides of the setpoint."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from rtloop.analysis.measured.multisine import excitation_sequence, make_grid
from rtloop.configuration.file import load
from rtloop.errors import ConfigError
from rtloop.service.measuring.measurement import TRIAL_PERIODS, _ExcitationRun, require_room
from tests.paper_configuration import PAPER


@pytest.mark.parametrize(("hold_um", "allowed_um", "limit"), [
    (5.0, 3.0, "2 µm"), (35.0, 5.0, "40 µm"),
])  # fmt: skip
def test_the_nearer_end_of_the_sensors_range_limits_a_motion(hold_um: float, allowed_um: float, limit: str) -> None:
    (axis,) = load(PAPER).axes
    require_room(axis, (2.0, 40.0), hold_um, allowed_um)
    reason = rf"the distance to {limit}, where the sensor's range ends \(axis\.x\.interlocks\.sensor_min_v and"
    with pytest.raises(ConfigError, match=f"allowed: up to {allowed_um:g} µm, {reason}"):
        require_room(axis, (2.0, 40.0), hold_um, allowed_um + 0.01)


@pytest.mark.parametrize("hold_um", [1.0, 41.0, 45.0])
def test_a_setpoint_beyond_an_end_leaves_no_room(hold_um: float) -> None:
    (axis,) = load(PAPER).axes
    refusal = rf"response: the setpoint {hold_um:g} µm leaves no room .*axis\.x\.interlocks\..*; use another setpoint"
    with pytest.raises(ConfigError, match=refusal):
        require_room(axis, (2.0, 40.0), hold_um, 0.1)


def test_a_fade_as_long_as_a_period_is_no_period_of_a_trial() -> None:
    lines = make_grid(10_000.0, 0.05, 40.0, 1_000.0, None)
    period = np.sin(2 * np.pi * np.arange(lines.samples) / lines.samples)
    played = excitation_sequence(period, TRIAL_PERIODS, 0.0, lines.samples)
    signals = dict.fromkeys(("error_um", "command_um", "position_um"), played)
    periods = _ExcitationRun(cast(Any, None), "sim")._whole_periods(lines, signals)
    for part in (periods.error, periods.command, periods.position):
        assert part.tobytes() == np.stack([period] * TRIAL_PERIODS).tobytes()
