"""The real service, its recovery and its clients on a loop in virtual time: one thread runs at a time.

A thread gives up its turn in `sleep`; the next turn is that of the thread that wakes first, after the loop has executed
the ticks until then. The order of all commands is therefore the same in every run, whatever the host does.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtloop.configuration.prepare import prepare
from rtloop.engine.messages import MESSAGE
from rtloop.foundation import timing
from rtloop.service import service
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Desk
from rtloop.service.recovering import worker
from rtloop.service.recovering.worker import RecoveryWorker
from rtloop.service.service import Service
from rtloop.signals import Mode
from rtloop.supervision.supervisor import Supervisor
from tests.engine.failing_driver import ScriptedDriver
from tests.engine.harness import LoopBench

RATE_HZ, WATCH_S = 1000.0, 0.005
LOCK_POLL_S, EVENT_POLL_S, UNIX_S = 0.0005, 0.005, 1.8e9
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


class EndOfTest(BaseException):
    """The test has ended, and with it each other thread."""


class Turns:
    """Turns of threads in virtual time; `advance` is called for each stretch of it."""

    def __init__(self, advance: Callable[[float], None]) -> None:
        self.now_s, self._advance = 1000.0, advance
        self._changed = threading.Condition()
        self._wakes_s: dict[threading.Thread, float] = {threading.current_thread(): self.now_s}
        self._turn: threading.Thread | None = threading.current_thread()

    def end(self) -> None:
        """End all other threads, where they sleep."""
        with self._changed:
            threads, self._turn = [*self._wakes_s], None
            self._changed.notify_all()
        for thread in threads:
            if thread is not threading.current_thread():
                threading.Thread.join(thread)

    def sleep(self, seconds: float) -> None:
        """Give up the turn for a time, in which other threads have theirs."""
        me = threading.current_thread()
        with self._changed:
            self._wakes_s[me] = self.now_s + seconds
            self._pass_on()
            self._await_turn(me)

    def start(self, work: Callable[[], object]) -> threading.Thread:
        """Start a thread whose first turn comes at once; its turns end with `work`."""

        def run() -> None:
            try:
                with self._changed:
                    self._await_turn(thread)
                work()
            except EndOfTest:
                pass
            finally:
                with self._changed:
                    del self._wakes_s[thread]
                    if self._turn is thread:
                        self._pass_on()

        thread = VirtualThread(self, run)
        self._wakes_s[thread] = self.now_s
        thread.start()
        return thread

    def _pass_on(self) -> None:
        """Give the turn to the thread that wakes first, after the time until then."""
        self._turn = min(self._wakes_s, key=lambda thread: self._wakes_s[thread])
        wake_s = max(self._wakes_s[self._turn], self.now_s)
        self._advance(wake_s - self.now_s)
        self.now_s = wake_s
        self._changed.notify_all()

    def _await_turn(self, me: threading.Thread) -> None:
        assert self._changed.wait_for(lambda: self._turn in (me, None), 60.0), "no turn: a thread waits for a real lock"
        if self._turn is None:
            raise EndOfTest


class VirtualThread(threading.Thread):
    """Thread whose end is awaited in virtual time."""

    def __init__(self, turns: Turns, work: Callable[[], None]) -> None:
        super().__init__(target=work, daemon=True)
        self._turns = turns

    def join(self, timeout: float | None = None) -> None:
        end_s = self._turns.now_s + (float("inf") if timeout is None else timeout)
        while self.is_alive() and self._turns.now_s < end_s:
            self._turns.sleep(EVENT_POLL_S)


class VirtualLock:
    """Lock for which a thread waits in virtual time."""

    def __init__(self, turns: Turns, lock: Any) -> None:
        self._turns, self._lock = turns, lock

    def __enter__(self) -> None:
        while not self._lock.acquire(blocking=False):
            self._turns.sleep(LOCK_POLL_S)

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def locked(self) -> bool:
        return bool(self._lock.locked())


class VirtualEvent(threading.Event):
    """Event for which a thread waits in virtual time."""

    def __init__(self, turns: Turns) -> None:
        super().__init__()
        self._turns = turns

    def wait(self, timeout: float | None = None) -> bool:
        end_s = self._turns.now_s + (float("inf") if timeout is None else timeout)
        while not self.is_set() and self._turns.now_s < end_s:
            self._turns.sleep(min(EVENT_POLL_S, end_s - self._turns.now_s))
        return self.is_set()


def virtual_time(turns: Turns) -> timing.Source:
    """Return the product's source of time in which threads take turns."""
    make: Any = VirtualLock
    return timing.Source(
        monotonic_s=lambda: turns.now_s,
        unix_s=lambda: UNIX_S + turns.now_s,
        sleep=turns.sleep,
        lock=lambda: make(turns, threading.Lock()),
        reentrant_lock=lambda: make(turns, threading.RLock()),
        event=lambda: VirtualEvent(turns),
        start_thread=turns.start,
    )


class SteppedSupervisor:
    """The part of a Supervisor that reads the loop's block; the loop runs in this process."""

    newest, latest, trip_reason = Supervisor.newest, Supervisor.latest, Supervisor.trip_reason
    ended, error = False, None

    def __init__(self, bench: LoopBench, prepared: Any) -> None:
        self.block, self.prepared = bench.block, prepared

    @property
    def ticks(self) -> int:
        return int(self.block["ticks_head"][0])


class VirtualService:
    """A service with a loop of one axis, mode feedforward and a sine; `more` ends its configuration.

    The reading follows the drive. While `hangs`, the loop executes no tick, as if its driver did not return.
    """

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, more: str = RECOVER, base: str = CONFIGURATION):
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
        self.driver = ScriptedDriver(
            lambda _: self.driver.written[-1] * UM_PER_V / 10.0 if self.driver.written else 0.0
        )
        self.bench = LoopBench(plan, self.driver)
        supervisor: Any = SteppedSupervisor(self.bench, prepared)
        self.service._desk = Desk(self.bench.block, RATE_HZ)
        self.service.live = LiveLaw(prepared, self.bench.block, self.service._desk, {})
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

    def drive_v(self, seconds: float) -> Sequence[float]:
        """Return the drives of the next ticks."""
        before = len(self.driver.written)
        self.turns.sleep(seconds)
        return self.driver.written[before:]

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
