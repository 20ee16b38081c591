"""The model's hysteresis curve agrees with the measured one, which an independent play model makes here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtloop.client.ticks.tick_stretch import Stretch
from rtloop.panel.feed.tick_history import TickHistory
from rtloop.panel.protocol.subscriptions import validate_field
from rtloop.panel.service.service import Description
from rtloop.panel.views.xy_plot import MODEL_BINS, XyPlot, extreme_indices, order_extremes
from rtloop.signals import Signal
from tests.panel.web.browser import unpack_message

pytestmark = pytest.mark.system

RATE_HZ, THRESHOLDS_V, WEIGHTS = 4000, (0.0, 1.0, 3.0, 5.0), (2.0, 1.0, 0.6, 0.4)
NAMES = ("tick", "deadline_ns", "x_drive_v", "x_position_um", "x_reference_um", "mode")
AXIS = {"name": "x", "feedforward": {"thresholds_v": THRESHOLDS_V, "weights_um_per_v": WEIGHTS}}
LOOP = Description(
    "lab", RATE_HZ, tuple(Signal(name, "", "") for name in NAMES), Path("b"), Path("r"), {"axis": [AXIS]}
)


def play_model(drive: np.ndarray) -> np.ndarray:
    """Return the position Σ w·y, y = max(u − r, min(u + r, y)), of a drive u from rest, µm (Visintin 1994)."""
    total = np.zeros(drive.size)
    for r, w in zip(THRESHOLDS_V, WEIGHTS, strict=True):
        y = 0.0
        for k, u in enumerate(drive):
            y = max(u - r, min(u + r, y))
            total[k] += w * y
    return total


def make_frame(drive: np.ndarray, position: np.ndarray, reference: np.ndarray) -> Any:
    """Return header and arrays of the frame of the last second of an axis in closed loop."""
    tick, history = np.arange(drive.size), TickHistory(NAMES, 8 * RATE_HZ)
    rows = np.column_stack([tick, tick * 1e6, drive, position, reference, 3.0 + 0 * drive]).astype(np.float64)
    history.append(Stretch(NAMES, 0, rows))
    frame = XyPlot(validate_field("xy", {"axis": "x", "seconds": 1.0}), LOOP).frame(history)
    assert frame is not None
    return unpack_message(frame)


def test_at_rest_there_is_noise_and_no_width_of_a_loop() -> None:
    noise = np.random.default_rng(1).normal(0.0, 0.01, (2, 2 * RATE_HZ))
    header, _ = make_frame(3.0 + noise[0], 12.5 + noise[1], reference=np.full(2 * RATE_HZ, 12.5))
    assert header["at_rest"]
    assert header["loop_percent"] is None


@pytest.mark.parametrize("begins", [0.03, 0.2, 0.35, 0.5, 0.72, 0.9])
def test_the_models_loop_knows_what_came_before_the_screen(begins: float) -> None:
    """The model's curve follows the measured one wherever in a period of the drive the screen begins."""
    ticks = round(6.0 * RATE_HZ + begins * RATE_HZ)
    drive = 9.0 * np.sin(2 * np.pi * np.arange(ticks) / RATE_HZ)
    truth = play_model(drive) + 0.7
    header, arrays = make_frame(drive, truth, reference=truth)
    assert not header["at_rest"]
    assert header["offset_um"] == pytest.approx(0.7, abs=0.05)
    indices = extreme_indices([drive[-RATE_HZ:]], MODEL_BINS)
    np.testing.assert_array_equal(arrays["model_drive_v"], np.float32(drive[-RATE_HZ:][indices]))
    np.testing.assert_allclose(arrays["model_position_um"], truth[-RATE_HZ:][indices], atol=0.1)


def test_extremes_are_in_the_order_of_the_drive() -> None:
    low, high = np.array([0.0, 1.0, np.nan, 2.0, 1.0, 0.0]), np.array([1.0, 2.0, np.nan, 3.0, 2.5, 1.0])
    assert order_extremes(low, high).tolist() == [0.0, 1.0, 1.0, 2.0, 2.0, 3.0, 2.5, 1.0, 1.0, 0.0]
    assert order_extremes(np.array([1.0]), np.array([2.0])).tolist() == [1.0, 2.0]
