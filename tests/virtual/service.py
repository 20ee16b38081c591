"""The real service and its recovery on a loop with a scripted driver, in virtual time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtloop.configuration.prepare import prepare
from rtloop.drivers.base import Channel, Facts, Wiring
from rtloop.drivers.python import PythonDriver
from rtloop.engine.messages import MESSAGE
from rtloop.foundation import timing
from rtloop.service import service
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Desk
from rtloop.service.recovering import worker
from rtloop.service.recovering.worker import RecoveryWorker
from rtloop.service.service import Service
from rtloop.signals import Mode
from tests.engine.failing_driver import ScriptedDriver
from tests.engine.harness import LoopBench
from tests.virtual.bench import VirtualSupervisor
from tests.virtual.turns import Turns, virtual_time

RATE_HZ, WATCH_S, TRIP_SLEW_V_PER_S = 1000.0, 0.005, 1000.0
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


class VirtualService:
    """A service with a loop of the axes x and y, mode feedforward and a sine; `more` ends its configuration.

    The reading follows the drive. While `hangs`, the loop executes no tick, as if its driver did not return.
    """

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, more: str = RECOVER, base: str = FEEDFORWARD):
        self.turns, self.hangs = Turns(self._advance), False
        monkeypatch.setattr(timing, "source", virtual_time(self.turns))
        (folder / "lab.toml").write_text(base + more)
        self.bench: LoopBench | None = None
        self.service = Service(folder / "lab.toml")
        self.service.second_opinion.require = lambda _: None  # type: ignore[method-assign]
        self.commands_sent = 0
        submit = Desk.submit

        def count_and_submit(*arguments: Any, **options: Any) -> int:
            self.commands_sent += 1
            return submit(*arguments, **options)

        monkeypatch.setattr(Desk, "submit", count_and_submit)
        self._undone_ticks, self._since_watch_s, self._is_watched = 0.0, 0.0, True

    def begin_loop(self) -> None:
        """Begin a loop with its outputs off, as after a failure, and let it execute its first ticks."""
        prepared = prepare(self.service.configuration, paced=False)
        plan = replace(prepared.plan, mode=Mode.OFF, schedule=np.zeros(0, MESSAGE), spare_samples=service.SPARE_SAMPLES)
        prepared = replace(prepared, plan=plan)
        self.driver = FollowingDriver()
        self.bench = LoopBench(plan, self.driver)
        supervisor: Any = VirtualSupervisor(self.bench, prepared)
        self.service._desk = Desk(self.bench.block, RATE_HZ)
        self.service.live = LiveLaw(prepared, self.bench.block, self.service._desk, self.service._offsets_v)
        self.service.supervisor = supervisor
        self.turns.sleep(0.01)

    def end_loop(self) -> None:
        """Take the loop away, as after the death of its process."""
        self.service.supervisor = self.service._desk = self.service.live = self.bench = None

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

    def wait_for(self, condition: Callable[[], bool], limit_s: float = 100.0) -> None:
        """Wait until the condition holds; fails after `limit_s` of virtual time."""
        end_s = self.turns.now_s + limit_s
        while not condition():
            assert self.turns.now_s < end_s, (self.service.state, self.recovery_state)
            self.turns.sleep(0.001)

    @property
    def recovery_state(self) -> str:
        report = self.service.recovery.for_json()
        return "" if report is None else str(report["state"])

    def drive_v(self, seconds: float) -> np.ndarray[Any, Any]:
        """Return the drives of the next ticks (ticks, axes)."""
        before = len(self.driver.written)
        self.turns.sleep(seconds)
        return np.array(self.driver.written[before:])

    def _advance(self, seconds: float) -> None:
        """Execute the ticks of a stretch of time, and read the loop's events every WATCH_S, as the service's watch."""
        while self.bench is not None and not self.hangs and seconds > 1e-9:
            part_s = min(seconds, WATCH_S)
            seconds -= part_s
            self._undone_ticks += part_s * RATE_HZ
            if (ticks := int(self._undone_ticks + 1e-6)) > 0:
                self._undone_ticks -= ticks
                self.bench.run(ticks)
            self.service._follow_events()
