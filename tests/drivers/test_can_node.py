"""Outputs of the simulated CAN node when drive frames stop and come again, by a clock that the test advances."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtloop.drivers.can import node as node_module
from rtloop.drivers.can.frames import choose_exchange, load_frames
from rtloop.drivers.can.node import RigNode
from tests.drivers.can_bench import options_on

PERIOD_S, WATCHDOG_MS, SLEW_V_PER_S = 0.001, 50.0, 100.0
STEP_V = SLEW_V_PER_S * PERIOD_S
LSB_V = 20.0 / 65536
SILENT = None


class Wire:
    """A bus that gives the node queued messages, one at a time, and drops its answers."""

    def __init__(self) -> None:
        self.messages: deque[Any] = deque()

    def recv(self, timeout: float) -> Any:
        return self.messages.popleft() if self.messages else None

    def send(self, message: Any) -> None:
        pass


class Bench:
    """A node that a test steps once a period, with or without a drive frame."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s, self.sequence = 0.0, 0
        monkeypatch.setattr(node_module, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        self.options = options_on(1, watchdog_ms=WATCHDOG_MS, park_slew_v_per_s=SLEW_V_PER_S)
        self.drive = choose_exchange(load_frames(self.options), 1, self.options).drive
        self.wire = Wire()
        self.node = RigNode(self.wire, self.options, ["x"])
        self._queue_drive(0, 0.0)
        self.node.step()

    def outputs(self, drive_v: float | None, periods: int) -> np.ndarray:
        """Return the output in V after each of `periods` periods with the drive `drive_v`, or with none (SILENT)."""
        outputs_v = []
        for _ in range(periods):
            self.now_s += PERIOD_S
            if drive_v is not SILENT:
                self.sequence += 1
                self._queue_drive(self.sequence, drive_v)
            self.node.step()
            outputs_v.append(self.node.drive_v[0])
        return np.array(outputs_v)

    def _queue_drive(self, sequence: int, drive_v: float) -> None:
        self.wire.messages.append(self.drive.message(self.options, (sequence, drive_v)))


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    """Return a node that has received its first drive frame."""
    return Bench(monkeypatch)


def test_a_silence_is_bridged_and_then_ramped_to_zero(bench):
    assert np.allclose(bench.outputs(5.0, 3), 5.0, atol=LSB_V)
    outputs_v = bench.outputs(SILENT, 120)
    assert np.allclose(outputs_v[:50], 5.0, atol=LSB_V)
    assert np.allclose(-np.diff(outputs_v[51:100]), STEP_V)
    assert np.all(outputs_v[101:] == 0.0)
    assert bench.node.parked == 1


def test_drives_that_come_again_are_reached_by_the_ramp(bench):
    bench.outputs(5.0, 3)
    bench.outputs(SILENT, 120)
    outputs_v = bench.outputs(3.0, 40)
    assert np.allclose(outputs_v[:29], STEP_V * np.arange(29), atol=2 * LSB_V)
    assert np.allclose(outputs_v[31:], 3.0, atol=LSB_V)
    assert bench.outputs(-4.0, 1) == pytest.approx(-4.0, abs=LSB_V)


def test_drives_that_come_again_during_the_ramp_turn_it(bench):
    bench.outputs(5.0, 3)
    half_way = bench.outputs(SILENT, 75)[-1]
    assert 2.0 < half_way < 3.0
    outputs_v = bench.outputs(4.0, 30)
    assert np.all(np.abs(np.diff([half_way, *outputs_v])) <= STEP_V + 1e-9)
    assert outputs_v[-1] == pytest.approx(4.0, abs=LSB_V)
