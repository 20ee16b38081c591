"""Supervisor, parking, recorder keeper and service after a process has failed, with clocks that the test moves."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtloop.configuration.recording import RecordingOptions
from rtloop.configuration.schedule import ScheduleOptions
from rtloop.engine.memory import ProcessState, SharedBlock, Sizes, Word
from rtloop.errors import LoopFault, OutputError, UnavailableError
from rtloop.foundation import timing
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.service import service as service_module
from rtloop.service.service import Service, State
from rtloop.service.status import status
from rtloop.supervision import parking, recorder_keeper
from rtloop.supervision.recorder_keeper import RecorderKeeper
from rtloop.supervision.stall import StallWatch
from rtloop.supervision.supervisor import Supervisor
from tests.laws.test_shipped import DEPLOY

SIZES = Sizes(columns=1, axes=1, rate_hz=1000.0, snapshot_bytes=8, table_samples=1)


class Clock:
    """Virtual time: `sleep` advances it at once."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds

    def source(self) -> timing.Source:
        return timing.Source(monotonic_s=self.monotonic, sleep=self.sleep)


@pytest.fixture
def block() -> SharedBlock:
    """Return a shared block of one axis at 1 kHz."""
    return SharedBlock.create(SIZES)


@pytest.mark.parametrize("drive_v", [-10.0, 10.0])
def test_a_loop_without_its_service_has_the_time_that_its_ramp_takes(block, monkeypatch, drive_v):
    """The loop is killed after the heartbeat timeout of 1 s and a ramp of 10 V at 2 V/s from either end."""
    clock, killed_s = Clock(), list[float]()
    monkeypatch.setattr(timing, "source", clock.source())
    monkeypatch.setattr(SharedBlock, "driver_pid", lambda _: None if killed_s else 4711)
    monkeypatch.setattr(SharedBlock, "kill_driver", lambda _: killed_s.append(clock.now_s))
    block["last_drive_v"][:] = drive_v
    parking._await_end(block, 1.0, 2.0, np.zeros(1))
    assert killed_s[0] - 1000.0 == pytest.approx(1.0 + 5.0 + parking.MARGIN_S, abs=2 * parking.POLL_S)


@pytest.mark.parametrize(
    ("is_ready", "processor_s", "text"),
    [
        (True, 0.1, "got too little of a processor on a busy host, had no tick for 1 s, and was killed"),
        (True, 0.9, "stood still and was killed"),  # such as a law that does not return
        (False, 0.0, "stood still and was killed"),
    ],
)
def test_a_loop_that_got_no_processor_is_told_from_one_that_stood_still(block, is_ready, processor_s, text):
    supervisor: Any = object.__new__(Supervisor)
    supervisor.block, supervisor._stall = block, StallWatch(1.0, 1.0)
    supervisor.prepared = SimpleNamespace(plan=SimpleNamespace(pacing=SimpleNamespace(paced=True)))
    supervisor._loop = SimpleNamespace(end=lambda: None, processor_s=7.0, is_ready_to_run=is_ready)
    block.store(Word.LOOP_STATE, ProcessState.RUNNING)
    block["ticks_head"][0] = 100
    assert not supervisor._kill_stalled_loop()
    supervisor._loop.processor_s += processor_s
    supervisor._stall._last_s -= 1.0
    assert supervisor._kill_stalled_loop()
    assert supervisor._stall_text == text


def test_a_loop_that_ramps_down_behind_its_last_tick_does_not_stand_still(block):
    """Ticks after the last recorded tick are not in the ring: its head stands still while the outputs ramp down."""
    supervisor: Any = object.__new__(Supervisor)
    end_calls: list[bool] = []
    supervisor.block, supervisor._stall = block, StallWatch(0.0, 1.0)
    supervisor.prepared = SimpleNamespace(plan=SimpleNamespace(pacing=SimpleNamespace(paced=True)))
    supervisor._loop = SimpleNamespace(end=lambda: end_calls.append(True), processor_s=0.0, is_ready_to_run=False)
    block.store(Word.LOOP_STATE, ProcessState.RUNNING)
    block["ticks_head"][0] = 100
    block.store(Word.FINISHED_TICKS, 100)
    assert not supervisor._kill_stalled_loop()
    block.store(Word.FINISHED_TICKS, 0)
    assert supervisor._kill_stalled_loop()
    assert end_calls == [True]


@pytest.mark.parametrize(("complete", "code"), [(True, 0), (False, LoopFault.exit_code)])
def test_a_recording_that_is_not_whole_is_no_success(complete, code):
    supervisor: Any = object.__new__(Supervisor)
    report = {"report": "finished", "outcome": "done", "driver_error": None}
    supervisor._loop = SimpleNamespace(wait=lambda _: 0, reports=lambda: [report], exit_code=0)
    supervisor._reports, supervisor.error, supervisor.recorder = {}, None, SimpleNamespace(notes=[])
    assert supervisor._result({"paths": [], "complete": complete}).exit_code == code


class IdleRecorder:
    """Process of a recorder that runs and does nothing."""

    def __init__(self, *_: object, **__: object) -> None:
        self.exit_code: int | None = None

    def end(self) -> bool:
        return True

    def send(self, _: bytes) -> None:
        """Accept orders, and do nothing."""


def make_keeper(block: SharedBlock, folder: Path) -> RecorderKeeper:
    """Return the keeper of an idle recorder that has its orders; the recordings are in `folder`."""
    options = RecordingOptions()
    keeper = RecorderKeeper(IdleRecorder(), block, RequesterNames.create(), folder / "lab-1.mcap", options)  # type: ignore[arg-type]
    keeper._has_orders = True
    return keeper


def test_a_recorder_that_cannot_start_is_told_in_the_totals(block, tmp_path, monkeypatch):
    keeper = make_keeper(block, tmp_path)

    def refuse() -> None:
        raise OutputError(f"{tmp_path}: No space left on device", 28)

    monkeypatch.setattr(keeper, "_start_recording", refuse)
    keeper._run()
    assert str(keeper.failure) == f"{tmp_path}: No space left on device"
    assert keeper.totals is not None
    assert (keeper.totals["complete"], keeper.totals["error"]) == (False, str(keeper.failure))
    assert not keeper.recording


@pytest.mark.parametrize(
    ("state", "is_refused"),
    [(ProcessState.FINISHED, False), (ProcessState.RUNNING, False), (ProcessState.FAILED, True)],
)
def test_a_recorder_may_finish_before_it_is_seen_running(block, tmp_path, monkeypatch, state, is_refused):
    """A stop during the start ends the loop, and the recorder finishes its file between two polls of its state."""
    keeper = make_keeper(block, tmp_path)
    keeper._child = SimpleNamespace(exit_code=0, wait=lambda _: 0, reports=list)  # type: ignore[assignment]
    monkeypatch.setattr(keeper, "_send_orders", lambda: block.store(Word.RECORDER_STATE, state))
    if is_refused:
        with pytest.raises(OutputError, match="cannot record"):
            keeper._start_recording()
    else:
        keeper._start_recording()


@pytest.mark.parametrize(("recorded", "replaced"), [(500, 0), (499, 1)])
def test_a_recorder_is_replaced_only_if_there_is_something_to_record(block, tmp_path, monkeypatch, recorded, replaced):
    """The recorder's cursor stands still for 10 s: at the newest tick the recorder is idle, behind it stuck."""
    clock = Clock()
    monkeypatch.setattr(timing, "source", clock.source())
    monkeypatch.setattr(recorder_keeper, "Child", IdleRecorder)
    keeper = make_keeper(block, tmp_path)
    block["ticks_head"][0] = 500
    block.store(Word.RECORDER_CURSOR, recorded)
    for _ in range(200):
        keeper._replace_if_dead()
        clock.sleep(0.05)
    assert keeper.replacements == replaced
    block.store(Word.RECORDER_STATE, ProcessState.READY)
    for _ in range(10):  # The replacement has its own time, which begins with its orders.
        keeper._replace_if_dead()
        clock.sleep(0.05)
    assert keeper.replacements == replaced


@pytest.mark.parametrize(
    ("loop", "code", "replaced"),
    [
        (ProcessState.FINISHED, 0, 0), (ProcessState.FINISHED, 1, 0), (ProcessState.FAILED, 0, 0),
        (ProcessState.RUNNING, 0, 1), (ProcessState.FINISHED, -9, 1),
    ],
)  # fmt: skip
def test_a_recorder_that_ended_with_its_loop_is_not_replaced(block, tmp_path, monkeypatch, loop, code, replaced):
    """The supervisor may see the end of the loop late; a killed recorder is replaced in any case."""
    monkeypatch.setattr(recorder_keeper, "Child", IdleRecorder)
    keeper = make_keeper(block, tmp_path)
    block.store(Word.LOOP_STATE, loop)
    keeper._child.exit_code = code  # type: ignore[misc]
    keeper._replace_if_dead()
    assert keeper.replacements == replaced


def test_the_pipes_of_the_last_recorder_are_closed(block, tmp_path, monkeypatch):
    """The last recorder may be a replacement of the first one."""
    keeper, end_calls = make_keeper(block, tmp_path), list[bool]()
    child: Any = keeper._child
    child.exit_code, child.wait, child.reports = 0, lambda _: 0, list
    monkeypatch.setattr(child, "end", lambda: end_calls.append(True), raising=False)
    keeper._finish()
    assert end_calls == [True]


def test_another_recorder_begins_behind_the_last_file_whatever_was_removed(block, tmp_path):
    """The quota has removed the files 1 to 3: the next number follows the highest one, even of an unfinished file."""
    keeper = make_keeper(block, tmp_path)
    keeper.replacements = 1
    (tmp_path / "lab-1-0004.mcap").touch()
    (tmp_path / "lab-1-0005.mcap.part").touch()
    assert keeper._next_sequence() == 6


def dying_loop_service(monkeypatch: pytest.MonkeyPatch, after_s: float, loops: int = 100) -> tuple[Service, list[bool]]:
    """Return a service whose loops each die after `after_s`, and a list that gets `outputs_off` of each loop.

    The service ends with loop number `loops`.
    """
    service, clock, outputs_off_flags = Service(DEPLOY / "paper.toml"), Clock(), list[bool]()
    options = service.configuration.service.model_copy(update={"restarts": 2, "restart_window_s": 60.0})
    service.configuration = replace(service.configuration, service=options)
    ended_thread: Any = SimpleNamespace(join=lambda timeout_s: None, is_alive=lambda: False)
    monkeypatch.setattr(timing, "source", replace(clock.source(), start_thread=lambda work: ended_thread))

    def run_loop(outputs_off: bool) -> Any:
        outputs_off_flags.append(outputs_off)
        clock.sleep(after_s)
        if len(outputs_off_flags) == loops:
            service.end()
        return SimpleNamespace(error="the loop's process died", outcome="killed", exit_code=70, notes=[])

    monkeypatch.setattr(service, "_run_loop", run_loop)
    return service, outputs_off_flags


def test_the_loop_after_one_that_died_begins_with_its_outputs_off(monkeypatch):
    service, outputs_off_flags = dying_loop_service(monkeypatch, after_s=1.0)
    with pytest.raises(LoopFault, match="the loop ended too often"):
        service.run()
    assert outputs_off_flags == [service.configuration.service.arm, True, True]


@pytest.mark.parametrize("driving", ["a schedule", "a depolarisation", "nothing but the mode"])
def test_nothing_drives_the_outputs_after_a_start_that_failed(monkeypatch, caplog, driving):
    """The service is tripped after a failed start, because an engineer may be working on the wiring."""
    service, outputs_off_flags = dying_loop_service(monkeypatch, after_s=1.0, loops=2)
    if driving == "a schedule":
        service.configuration = replace(service.configuration, schedule=[ScheduleOptions(at_tick=5, mode="off")])
    if driving == "a depolarisation":
        options = service.configuration.service.model_copy(update={"tare_s": 0.5})
        service.configuration = replace(service.configuration, service=options)
    run_loop = service._run_loop

    def fail_at_first_start(outputs_off: bool) -> Any:
        result = run_loop(outputs_off)
        if len(outputs_off_flags) == 1:
            raise UnavailableError("no board")
        return result

    monkeypatch.setattr(service, "_run_loop", fail_at_first_start)
    service.run()
    assert (outputs_off_flags, service.state) == ([False, True], State.TRIPPED)
    assert ("neither depolarised nor tared" in caplog.text) == (driving == "a depolarisation")


def test_each_tared_axis_keeps_its_offset_in_the_next_loop(monkeypatch):
    offsets_v: list[list[float]] = []

    def refuse_start(_: object, prepared: Any, *__: object) -> None:
        offsets_v.append(prepared.plan.coefficients["offset_v"].tolist())
        raise UnavailableError("no loop starts in this test")

    monkeypatch.setattr(service_module, "Supervisor", refuse_start)
    monkeypatch.setattr(service_module, "Processes", lambda _: nullcontext())
    monkeypatch.setattr(service_module, "write_note", lambda *_: None)
    service = Service(DEPLOY / "two-axis.toml")
    service._offsets_v |= {0: 0.1, 1: 0.2}
    with pytest.raises(UnavailableError):
        service._run_loop(outputs_off=True)
    assert offsets_v == [[0.1, 0.2]]


@pytest.mark.parametrize(("is_ending", "state"), [(False, State.TRIPPED), (True, State.STARTING)])
def test_a_loop_that_ended_by_itself_is_tripped_before_its_fault_is_latched(monkeypatch, is_ending, state):
    """A client that looks in between must not take the service for one that is about to run."""

    class FailingSupervisor:
        def __init__(self, *_: object) -> None:
            pass

        def start(self) -> None:
            raise UnavailableError("no loop starts in this test")

        def close(self) -> None:
            pass

    monkeypatch.setattr(service_module, "Supervisor", FailingSupervisor)
    monkeypatch.setattr(service_module, "Processes", lambda _: nullcontext())
    monkeypatch.setattr(service_module, "write_note", lambda *_: None)
    service = Service(DEPLOY / "two-axis.toml")
    if is_ending:
        service.end()
    with pytest.raises(UnavailableError):
        service._run_loop(outputs_off=True)
    assert (service.faults, service.state) == ([], state)
    service._latch("the loop's fault")
    service.faults.clear()  # as a reset does
    assert service.state is State.STARTING


def test_a_status_without_a_tick_says_why_it_has_no_axes(monkeypatch):
    service, _ = dying_loop_service(monkeypatch, after_s=1.0)
    assert "axes" not in status(service)
    assert status(service)["no_signals"] == "the loop has not executed a tick yet"
    with pytest.raises(LoopFault):
        service.run()
    report = status(service)
    assert (report["state"], "axes" in report) == ("tripped", False)
    assert report["no_signals"] == "the last loop has ended, and the next loop has not executed a tick yet"


def test_deaths_that_lie_far_apart_are_not_too_many(monkeypatch):
    service, outputs_off_flags = dying_loop_service(monkeypatch, after_s=31.0, loops=10)
    assert service.run() == 70
    assert len(outputs_off_flags) == 10
