"""The spectrum of one client has all samples since the last reset and none before."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtloop.client.ticks.tick_stretch import DEADLINE_NS, Stretch
from rtloop.panel.feed.rest_detector import find_axis, is_at_rest
from rtloop.panel.protocol.subscriptions import validate_field
from rtloop.panel.views.analyser import Analyser
from tests.panel.web.browser import unpack_message

pytestmark = pytest.mark.system

RATE_HZ = 1000.0
LOOP: Any = SimpleNamespace(rate_hz=RATE_HZ, unit=lambda _: "V", axes={"x": {}})
NAMES = (DEADLINE_NS, "x_drive_v", "x_reference_um", "mode")


def feed(analyser: Analyser, volts: np.ndarray[Any, Any], first: int, run: int = 0, reference: Any = 0.0) -> int:
    """Feed drives (V) in closed loop from tick `first` on, in stretches of 17 ticks; return the tick after them."""
    rows = np.column_stack([np.zeros(volts.size), volts, np.broadcast_to(reference, volts.size), 3.0 + 0 * volts])
    rows[:, 0] = (first + np.arange(volts.size)) * 1e9 / RATE_HZ
    for start in range(0, volts.size, 17):
        analyser.feed(Stretch(NAMES, first + start, rows[start : start + 17], 0, run))
    return first + volts.size


@pytest.mark.parametrize("cause", ["reset", "another run"])
def test_a_reset_discards_earlier_samples_and_keeps_later_ones(cause: str) -> None:
    analyser = Analyser(validate_field("spectrum", {"signal": "x_drive_v"}), LOOP)
    tick = feed(analyser, np.full(4100, 0.0) + 1e6 * (np.arange(4100) % 2), 0)
    if cause == "reset":
        analyser.reset()
    sine = np.sqrt(2) * np.sin(2 * np.pi * 100 * np.arange(4096) / RATE_HZ)
    feed(analyser, sine, tick, run=int(cause != "reset"))
    header, arrays = unpack_message(analyser.frame())
    assert header["averages_most"] == 7, "7 half-overlapping segments of 1024 samples fill the 4096 samples"
    assert header["rms"] == pytest.approx(1.0, rel=0.01)
    assert arrays["hz"][np.argmax(arrays["amplitude"])] == pytest.approx(100.0, abs=0.5)


def test_the_spectrum_of_an_axis_at_rest_is_called_noise_until_its_reference_moves() -> None:
    analyser = Analyser(validate_field("spectrum", {"signal": "x_drive_v"}), LOOP)
    at_rest = lambda: unpack_message(analyser.frame())[0]["at_rest"]
    tick = feed(analyser, np.zeros(170), 0, reference=5.0)
    assert at_rest()
    tick = feed(analyser, np.zeros(170), tick, reference=5.001)  # The reference steps between two stretches.
    assert not at_rest()
    analyser.reset()
    tick = feed(analyser, np.zeros(170), tick, reference=5.001)
    assert at_rest()
    feed(analyser, np.zeros(170), tick, reference=np.arange(170.0))
    assert not at_rest()


@pytest.mark.parametrize(
    ("reference", "mode", "at_rest"),
    [((1.0, 1.0), (3, 3), True), ((1.0, 2.0), (3, 3), False), ((1.0, 2.0), (0, 0), True), ((1.0, 1.0), (0, 3), False),
     ((1.0, np.nan), (3, 3), True)],
)  # fmt: skip
def test_an_axis_is_at_rest_while_reference_and_mode_are_constant(reference: Any, mode: Any, at_rest: bool) -> None:
    assert is_at_rest(np.array(reference), np.array(mode, dtype=float)) == at_rest


def test_a_signal_belongs_to_the_axis_with_the_longest_name_that_fits() -> None:
    assert find_axis("x_fine_drive_v", ["x", "x_fine"]) == "x_fine"
    assert find_axis("tick", ["x", "x_fine"]) is None
