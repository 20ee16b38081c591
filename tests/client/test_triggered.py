"""Waiting for a trigger ends in time even in a loop so fast that the reader always has a new tick."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.client.capture import triggered_capture as triggered
from rtloop.client.capture.conditions import Edge
from rtloop.client.capture.trigger import Mode, Settings
from rtloop.client.ticks.tick_stretch import Stretch
from rtloop.errors import RtloopError

CONFIGURATION = {"block": "none", "columns": [{"name": "x_position_um"}]}


class EndlessReader:
    """Replacement of the reader: each read returns one more tick n, with a position of n µm."""

    def __init__(self, *_: object) -> None:
        self.tick = -1

    def read(self) -> Stretch:
        self.tick += 1
        assert self.tick < 100_000, "the wait does not end"
        return Stretch(["x_position_um"], self.tick, np.array([[float(self.tick)]]))


def test_waiting_for_a_trigger_ends_in_time_and_finds_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(triggered, "Reader", EndlessReader)
    settings = Settings(ticks=4, mode=Mode.SINGLE, pre_percent=0.0)
    assert triggered._await_trigger(CONFIGURATION, 3, settings, Edge("x_position_um", 9.0), 60.0) == 9
    with pytest.raises(RtloopError, match=r"no trigger within 0\.02 s"):
        triggered._await_trigger(CONFIGURATION, 3, settings, Edge("x_position_um", 1e9), 0.02)
