"""The real service and its loop in virtual time, in the test's process: what every bench of this folder shares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
import pytest

from rtloop.configuration.prepare import prepare
from rtloop.drivers.base import Driver
from rtloop.engine.messages import MESSAGE
from rtloop.foundation import timing
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.service import service
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Desk
from rtloop.service.service import Service
from rtloop.signals import Mode
from rtloop.supervision.supervisor import Supervisor
from tests.engine.harness import LoopBench
from tests.virtual.turns import Turns, virtual_time

T = TypeVar("T")
WATCH_S = 0.005
"""Pause between two looks of the service at its loop."""


class VirtualSupervisor:
    """The part of a Supervisor that reads the loop's block; the loop runs in this process, and nothing is recorded."""

    newest, latest, trip_reason = Supervisor.newest, Supervisor.latest, Supervisor.trip_reason
    ended, error, realtime = False, None, {}

    def __init__(self, loop: LoopBench, prepared: Any) -> None:
        self.block, self.prepared = loop.block, prepared
        self.recorder = SimpleNamespace(written_state={}, replacements=0, quota=None)
        self.names = RequesterNames.create()

    @property
    def ticks(self) -> int:
        return int(self.block["ticks_head"][0])


class VirtualLoop:
    """A service whose loop is executed as far as virtual time passes; `text` is its configuration.

    While `hangs`, the loop executes no tick, as if its driver did not return.
    """

    poll_s = 0.001

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
        self.folder, self.config = folder, folder / "lab.toml"
        self.config.write_text(text)
        self.turns, self.hangs = Turns(self._advance), False
        monkeypatch.setattr(timing, "source", virtual_time(self.turns))
        self.service = Service(self.config)
        self.service.second_opinion.require = lambda _: None  # type: ignore[method-assign]
        self.loop: LoopBench | None = None
        self._undone_ticks = 0.0

    def execute(self, driver: Driver | None = None) -> LoopBench:
        """Begin a loop of the service's configuration, off, with the configured driver or `driver`."""
        prepared = prepare(self.service.configuration, paced=False)
        plan = replace(prepared.plan, mode=Mode.OFF, schedule=np.zeros(0, MESSAGE), spare_samples=service.SPARE_SAMPLES)
        prepared = replace(prepared, plan=plan)
        self.loop = LoopBench(plan, driver)
        supervisor: Any = VirtualSupervisor(self.loop, prepared)
        self.service._desk = Desk(self.loop.block, plan.pacing.rate_hz, supervisor.names)
        self.service.live = LiveLaw(prepared, self.loop.block, self.service._desk, self.service._offsets_v)
        self.service.supervisor = supervisor
        return self.loop

    def end(self) -> None:
        """End all threads."""
        self.turns.end()

    def wait_for(self, condition: Callable[[], T], what: str = "change", limit_s: float = 20.0) -> T:
        """Wait until the condition holds and return its value; fails after `limit_s` of virtual time."""
        end_s = self.turns.now_s + limit_s
        while not (value := condition()):
            assert self.turns.now_s < end_s, f"no {what} within {limit_s:g} s; {self.service.state}, {self.recovery}"
            self.turns.sleep(self.poll_s)
        return value

    @property
    def recovery(self) -> dict[str, Any]:
        """The report of the recovery; empty without one."""
        return self.service.recovery.for_json() or {}

    def executed(self, rows: np.ndarray[Any, Any]) -> None:
        """Take the records that the loop has made."""

    def _advance(self, seconds: float) -> None:
        """Execute the ticks of a stretch of time, and read the loop's events every WATCH_S, as the service's watch."""
        while self.loop is not None and not self.hangs and seconds > 1e-9:
            part_s = min(seconds, WATCH_S)
            seconds -= part_s
            self._undone_ticks += part_s * self.loop.plan.pacing.rate_hz
            if (ticks := int(self._undone_ticks + 1e-6)) > 0:
                self._undone_ticks -= ticks
                self.executed(self.loop.run(ticks))
            self.service._follow_events()
