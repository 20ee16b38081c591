"""The motion of a measurement stays within position interlock and sensor's range, to both sides of the setpoint."""

from __future__ import annotations

import pytest

from rtloop.configuration.file import load
from rtloop.errors import ConfigError
from rtloop.service.measuring.measurement import require_room
from tests.paper_configuration import PAPER


@pytest.mark.parametrize(("hold_um", "allowed_um", "limit"), [
    (5.0, 3.0, "sensor's range from 2 µm on"), (35.0, 5.0, "sensor's range up to 40 µm"),
])  # fmt: skip
def test_the_nearer_end_of_the_sensors_range_limits_a_motion(hold_um: float, allowed_um: float, limit: str) -> None:
    (axis,) = load(PAPER).axes
    require_room(axis, (2.0, 40.0), hold_um, allowed_um)
    with pytest.raises(ConfigError, match=f"allowed: up to {allowed_um:g} µm, by axis.x.interlocks.*{limit}"):
        require_room(axis, (2.0, 40.0), hold_um, allowed_um + 0.01)
