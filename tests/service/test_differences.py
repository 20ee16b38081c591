"""Texts of the differences between two versions of an axis, as the panel shows them."""

from __future__ import annotations

from typing import Any

import pytest

from rtloop.configuration.axis import AxisOptions
from rtloop.service.changing.differences import differences

AXIS: dict[str, Any] = {
    "name": "x",
    "feedforward": {"thresholds_v": [0.0], "weights_um_per_v": [4.3]},
    "controller": {"form": "zpk", "gain": 200.0, "poles": [[0.0, 0.0]]},
}


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({}, ""),
        ({"controller": {**AXIS["controller"], "gain": 150.0}}, "controller.gain 200 → 150"),
        ({"controller": {**AXIS["controller"], "poles": [[-1.0, 0.0]]}}, "controller.poles changed"),
        ({"controller": None}, "controller a table → none"),
        ({"limits": {"command_um": 25.5}}, "limits.command_um 42 → 25.5"),
        (
            {"interlocks": {"position_um": 1.0, "tracking_error_um": 2.0, "tracking_ticks": 3, "frozen_ticks": 4}},
            "interlocks.position_um {position_um:g} → 1",
        ),
    ],
)
def test_a_difference_is_its_key_before_and_after(changes: dict, text: str) -> None:
    before = AxisOptions.model_validate(AXIS)
    after = AxisOptions.model_validate(AXIS | changes)
    description = differences(before, after)
    assert description.startswith(text.format(position_um=before.interlocks.position_um))
    assert description.endswith(", and 1 more") == (len(changes.get("interlocks", ())) == 4)
