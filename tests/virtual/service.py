"""The real service and its recovery on a loop with a scripted driver, in virtual time."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtloop.drivers.base import Channel, Facts, Wiring
from rtloop.drivers.python import PythonDriver
from rtloop.service.desk import Desk
from rtloop.service.recovering import worker
from rtloop.service.recovering.worker import RecoveryWorker
from tests.engine.failing_driver import ScriptedDriver
from tests.virtual.loop import VirtualLoop

RATE_HZ, TRIP_SLEW_V_PER_S = 1000.0, 1000.0
UM_PER_V = np.array([4.0, 2.0])
HEAD = f"""
[loop]
rate_hz = {RATE_HZ:g}
mode = "feedforward"
[driver]
kind = "sim"
[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 10.0
[driver.channels.y]
input = "adc1"
output = "dac1"
um_per_v = 10.0
"""
"""The loop without its axes, as `axis_text` has them."""


def axis_text(name: str, um_per_v: float, amplitude: float, offset: float) -> str:
    """Return the configuration of an axis, whose reference is a sine."""
    return f"""
[[axis]]
name = "{name}"
[axis.feedforward]
thresholds_v = [0.0]
weights_um_per_v = [{um_per_v}]
[axis.limits]
bump_s = 0.002
trip_slew_v_per_s = {TRIP_SLEW_V_PER_S:g}
[axis.interlocks]
sample_age_us = 1000.0
[axis.reference]
kind = "sine"
amplitude = {amplitude}
offset = {offset}
frequency_hz = 25.0
"""


FEEDFORWARD = HEAD + axis_text("x", 4.0, 4.0, 12.0) + axis_text("y", 2.0, 2.0, 12.0)
RAW = HEAD.replace("feedforward", "raw") + axis_text("x", 4.0, 1.0, 3.0) + axis_text("y", 2.0, 1.0, 6.0)
RECOVER = """
[service.recover]
wait_s = 0.1
confirmations = 2
confirmation_s = 0.02
max_per_hour = 10
"""


class FollowingDriver(ScriptedDriver):
    """Driver of the axes x and y, whose readings follow their drives; `written` has the drives of both."""

    def __init__(self) -> None:
        PythonDriver.__init__(
            self, self.options_model(), {"x": Wiring("adc0", "dac0"), "y": Wiring("adc1", "dac1")}, 10_000
        )
        self.written: list[Sequence[float]] = []  # type: ignore[assignment]
        self.offsets_v = np.zeros(2)
        """Readings of the axes at a drive of 0 V."""

    @property
    def facts(self) -> Facts:
        inputs, outputs = (tuple(Channel(f"{kind}{number}") for number in range(2)) for kind in ("adc", "dac"))
        return Facts(inputs, outputs, (), real=False)

    def read(self) -> Sequence[float]:
        drives_v = np.array(self.written[-1]) if self.written else np.zeros(2)
        return tuple((self.offsets_v + UM_PER_V / 10.0 * drives_v).tolist())

    def observe(self) -> Sequence[float]:
        return ()

    def write(self, volts: Sequence[float]) -> None:
        self.written.append(tuple(volts))


class VirtualService(VirtualLoop):
    """A service with a loop of the axes x and y, mode feedforward and a sine; `more` ends its configuration.

    The reading follows the drive.
    """

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, more: str = RECOVER, base: str = FEEDFORWARD):
        super().__init__(folder, monkeypatch, base + more)
        self.commands_sent = 0
        submit = Desk.submit

        def count_and_submit(*arguments: Any, **options: Any) -> int:
            self.commands_sent += 1
            return submit(*arguments, **options)

        monkeypatch.setattr(Desk, "submit", count_and_submit)

    def begin_loop(self) -> None:
        """Begin a loop with its outputs off, as after a failure, and let it execute its first ticks."""
        self.driver = FollowingDriver()
        self.execute(self.driver)
        self.turns.sleep(0.01)

    def end_loop(self) -> None:
        """Take the loop away, as after the death of its process."""
        self.service.supervisor = self.service._desk = self.service.live = self.loop = None

    def start_recovery(self) -> threading.Thread:
        """Start the thread of the recovery, for 1000 s."""
        recovery_worker, end_s = RecoveryWorker(self.service, self.service.recovery), self.turns.now_s + 1000.0

        def work() -> None:
            while self.turns.now_s < end_s:
                recovery_worker.step()
                self.turns.sleep(worker.PERIOD_S)

        return self.turns.start(work)

    def trip(self) -> None:
        """Let a sample be too old once, in a loop that drives."""
        self.driver.sample_age_us = 1e6
        self.turns.sleep(0.02)
        self.driver.sample_age_us = 0.0

    @property
    def recovery_state(self) -> str:
        return str(self.recovery.get("state", ""))

    def drive_v(self, seconds: float) -> np.ndarray[Any, Any]:
        """Return the drives of the next ticks (ticks, axes)."""
        before = len(self.driver.written)
        self.turns.sleep(seconds)
        return np.array(self.driver.written[before:])
