"""A setpoint that would trip the position interlock is refused before it is sent."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rtloop.errors import ConfigError
from rtloop.kernel.reference import Generator
from rtloop.service.changing.references import LiveReferences
from tests.paper_configuration import built


def live_references(in_raw_mode: bool, sent: list[list[float]]) -> LiveReferences:
    """Return live references of the paper's axis with a position interlock of 15 µm; their commands go to `sent`."""
    prepared = built(("position_um = 60.0", "position_um = 15.0"))
    desk = SimpleNamespace(submit=lambda kind, axis, values: sent.append(values) or 1)
    staging: Any = SimpleNamespace(in_raw_mode=in_raw_mode, desk=desk)
    return LiveReferences(lambda: prepared, staging)


@pytest.mark.parametrize("value", [15.5, -15.5])
def test_a_setpoint_beyond_the_position_interlock_is_refused(value: float) -> None:
    sent: list[list[float]] = []
    with pytest.raises(ConfigError, match=r"reference: -?15\.5 µm; allowed: within ±15 µm \(interlocks\.position_um\)"):
        live_references(False, sent).play(0, [Generator.HOLD, value], built().plan.table[:0])
    assert sent == []


@pytest.mark.parametrize(("in_raw_mode", "value"), [(False, 15.0), (True, -9.0)])
def test_a_setpoint_within_it_and_volts_are_sent(in_raw_mode: bool, value: float) -> None:
    sent: list[list[float]] = []
    live_references(in_raw_mode, sent).play(0, [Generator.HOLD, value], built().plan.table[:0])
    assert sent == [[Generator.HOLD, value]]


def test_a_setpoint_that_was_held_before_comes_back_whatever_the_interlock_is_now() -> None:
    sent: list[list[float]] = []
    live_references(False, sent).play(0, [Generator.HOLD, 15.5], built().plan.table[:0], restores=True)
    assert sent == [[Generator.HOLD, 15.5]]
