"""The real service and its recovery on a loop with a scripted driver, in virtual time."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from rtloop.service.desk import Desk
from rtloop.service.recovering import worker
from rtloop.service.recovering.worker import RecoveryWorker
from tests.engine.failing_driver import ScriptedDriver
from tests.virtual.loop import VirtualLoop

RATE_HZ = 1000.0
UM_PER_V = 4.0
CONFIGURATION = f"""
[loop]
rate_hz = {RATE_HZ:g}
mode = "feedforward"
[driver]
kind = "sim"
[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 10.0
[[axis]]
name = "x"
[axis.feedforward]
thresholds_v = [0.0]
weights_um_per_v = [{UM_PER_V}]
[axis.limits]
bump_s = 0.002
trip_slew_v_per_s = 1000.0
[axis.interlocks]
sample_age_us = 1000.0
[axis.reference]
kind = "sine"
amplitude = 4.0
offset = 12.0
frequency_hz = 25.0
"""
RECOVER = """
[service.recover]
wait_s = 0.1
confirmations = 2
confirmation_s = 0.02
max_per_hour = 10
"""


class VirtualService(VirtualLoop):
    """A service with a loop of one axis, mode feedforward and a sine; `more` ends its configuration.

    The reading follows the drive.
    """

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, more: str = RECOVER, base: str = CONFIGURATION):
        super().__init__(folder, monkeypatch, base + more)
        self.commands_sent = 0
        submit = Desk.submit

        def count_and_submit(*arguments: Any, **options: Any) -> int:
            self.commands_sent += 1
            return submit(*arguments, **options)

        monkeypatch.setattr(Desk, "submit", count_and_submit)

    def begin_loop(self) -> None:
        """Begin a loop with its outputs off, as after a failure, and let it execute its first ticks."""
        self.driver = ScriptedDriver(
            lambda _: self.driver.written[-1] * UM_PER_V / 10.0 if self.driver.written else 0.0
        )
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

    def drive_v(self, seconds: float) -> Sequence[float]:
        """Return the drives of the next ticks."""
        before = len(self.driver.written)
        self.turns.sleep(seconds)
        return self.driver.written[before:]
