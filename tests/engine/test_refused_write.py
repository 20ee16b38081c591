"""The ramp to the safe value on a card that refuses writes: no step of the output is larger than the ramp's."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.drivers.base import Channel, Facts, Wiring
from rtloop.drivers.errors import DriverError
from rtloop.drivers.python import PythonDriver
from rtloop.engine import ramp as ramp_module
from rtloop.engine.ramp import ramp_to_safe
from rtloop.foundation.options import Options

DRIVE_V, STEP_V, RATE_HZ = 1.0, 0.125, 10_000.0


class RefusingCard(PythonDriver):
    """Card that refuses the writes whose numbers, from 0, are in `refused`; `written_v` has the accepted ones."""

    kind = "refusing"
    options_model = Options
    refused: range = range(0)

    def __init__(self) -> None:
        super().__init__(Options(), {"x": Wiring("in", "out")}, RATE_HZ)
        self.write_count, self.written_v = 0, [DRIVE_V]

    @property
    def facts(self) -> Facts:
        return Facts((Channel("in"),), (Channel("out"),))

    def start(self) -> None:
        pass

    def read(self) -> tuple[float]:
        return (0.0,)

    def write(self, volts: list[float]) -> None:
        self.write_count += 1
        if self.write_count - 1 in self.refused:
            raise OSError("the card refuses")
        self.written_v.append(volts[0])

    def stop(self) -> None:
        pass


def park(card: RefusingCard) -> None:
    """Open the card, ramp its output from DRIVE_V to 0 V, and close it."""
    pointers = card.open()
    try:
        ramp_to_safe(card, pointers, np.array([DRIVE_V]), STEP_V * RATE_HZ)
    finally:
        card.close()


def test_a_write_that_was_refused_is_tried_again_and_nothing_steps():
    card = RefusingCard()
    card.refused = range(3, 6)
    park(card)
    np.testing.assert_allclose(np.diff(card.written_v)[:8], -STEP_V)
    assert card.written_v[-1] == 0.0


def test_a_card_that_refuses_all_is_given_up(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(ramp_module, "GIVE_UP_S", 0.0)
    card = RefusingCard()
    card.refused = range(3, 1_000_000)
    with pytest.raises(DriverError):
        park(card)
    assert card.written_v == [1.0, 0.875, 0.75, 0.625]
