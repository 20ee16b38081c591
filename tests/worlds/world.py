"""A world: the real service, its API, supervisor, recorder, recovery and loop in one process, in virtual time.

Only processes are replaced: the child of a supervisor is a thread that takes turns. A board of simulated axes
outlives loops. All that happens is in `record`.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import pickle
import random
import tempfile
import threading
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from rtloop.configuration.file import Configuration
from rtloop.configuration.prepare import prepare
from rtloop.drivers.base import Channel, Facts, Wiring
from rtloop.drivers.python import PythonDriver
from rtloop.engine import ramp
from rtloop.engine.assembly import Assembly, law_at_rest
from rtloop.engine.clock import clock_context, unpaced_clock
from rtloop.engine.loop import Outcome
from rtloop.engine.memory import ProcessState, SharedBlock, Word
from rtloop.engine.plan import Plan
from rtloop.engine.process import EXIT_CODES, _fault_text
from rtloop.foundation import timing
from rtloop.recording.capture import progress, recorder, session
from rtloop.service import desk, lock, service, status
from rtloop.service.api.application import application
from rtloop.service.api.lanes import Lanes
from rtloop.service.changing import building
from rtloop.service.recovering.worker import run_recovery
from rtloop.service.service import Service
from rtloop.supervision import recorder_keeper, supervisor
from tests.virtual.bench import answer_in_process, run_in_lane
from tests.virtual.turns import Turns, virtual_time

STRETCH_S = 0.005
FOR_EVER = 1 << 62
KILLED = -9
ANNOUNCED = [int(word) for word in (*progress.ANNOUNCED, Word.ANNOUNCED_BYTE)]
request_number = ContextVar[int]("request_number", default=-1)
"""Number of the request for which a thread works; -1 for the service's own work."""


class Killed(BaseException):
    """The process that this thread stands for was killed."""


class Command(NamedTuple):
    """A command that was sent to the loop, and the number of ticks until then."""

    kind: int
    identity: int
    sent_s: float
    tick: int
    is_urgent: bool


@dataclass
class Request:
    """A request, its answer, and the numbers of the commands that were sent for it."""

    number: int
    client: str
    method: str
    path: str
    body: Any
    sent_s: float
    code: int | None = None
    answer: Any = None
    answered_s: float = float("inf")
    commands: list[Command] = field(default_factory=list)
    run: Run | None = None
    """The loop to which its last command was sent."""

    def __str__(self) -> str:
        text = f"request {self.number} of {self.client!r}: {self.method} {self.path} {self.body}"
        return f"{text}, {self.code} {self.answer}"


@dataclass
class Run:
    """A loop from its begin to its end: its records, events and, at each tick, the outputs that the board received."""

    fd: int
    """Descriptor of its shared block."""
    began_s: float
    rows: list[np.ndarray[Any, Any]] = field(default_factory=list)
    events: list[np.ndarray[Any, Any]] = field(default_factory=list)
    event_times_s: list[float] = field(default_factory=list)
    ended_s: float | None = None
    outcome: str = ""

    @property
    def ticks(self) -> int:
        return sum(map(len, self.rows))


class Board:
    """Card with two axes, each with a lag; `volts` are its outputs. Faults are set from outside."""

    def __init__(self, um_per_v: Sequence[float], lag: float) -> None:
        self.um_per_v, self._lag = um_per_v, lag
        self.volts, self.position_um = [0.0] * len(um_per_v), [0.0] * len(um_per_v)
        self.age_us = 0.0
        self.jump_um, self.replacement_v = 0.0, None
        self.refuses_read = self.refuses_write = self.is_gone = False
        self.written: list[tuple[float, ...]] = []

    def read(self) -> list[float]:
        if self.refuses_read:
            raise OSError("the card does not answer")
        for axis, gain in enumerate(self.um_per_v):
            self.position_um[axis] += self._lag * (gain * self.volts[axis] - self.position_um[axis])
        values = [(position + self.jump_um) / 10.0 for position in self.position_um]
        if self.replacement_v is not None:
            values[-1] = self.replacement_v
        return values

    def write(self, volts: Sequence[float]) -> None:
        if self.refuses_write:
            raise OSError("the card refuses the write")
        self.volts = [*volts]
        self.written.append(tuple(volts))


class BoardDriver(PythonDriver):
    """Driver of a board."""

    kind = "board"

    def __init__(self, board: Board) -> None:
        axes = "xy"[: len(board.volts)]
        wiring = {axis: Wiring(f"adc{i}", f"dac{i}") for i, axis in enumerate(axes)}
        super().__init__(self.options_model(), wiring, 1000.0)
        self._board = board

    @property
    def facts(self) -> Facts:
        count = range(len(self._board.volts))
        return Facts(tuple(Channel(f"adc{i}") for i in count), tuple(Channel(f"dac{i}") for i in count), (), real=False)

    def start(self) -> None:
        if self._board.is_gone:
            raise OSError("the card is not there")

    def stop(self) -> None:
        """Do nothing: the board stays."""

    def outputs_v(self) -> list[float]:
        return [*self._board.volts]

    def read(self) -> Sequence[float]:
        self.sample_age_us = self._board.age_us
        return self._board.read()

    def write(self, volts: Sequence[float]) -> None:
        self._board.write(volts)


class VirtualChild:
    """A child of the supervisor in a virtual thread, in place of `rtloop.supervision.child.Child`."""

    processor_s, is_ready_to_run = 0.0, False

    def __init__(self, world: World, module: str, fd: int, **_: int) -> None:
        self.world, self.fd = world, fd
        self.exit_code: int | None = None
        self.input: list[bytes] = []
        self.is_closed = False
        self.is_doomed = False
        self._reports: list[dict[str, Any]] = []
        self.session: session.Session | None = None
        world.fds.add(fd)
        if module == recorder_keeper.MODULE:
            self._work: Callable[[], int] = self._record
            world.recorders.append(self)
        else:
            self._work = self._drive
            world.loops.append(self)
        self.thread = world.start(self._run)

    def _run(self) -> None:
        try:
            code = self._work()
        except Killed:
            code = KILLED
            if self.session is not None:
                self.session._block["words"][ANNOUNCED] = self._announced  # The stack's end has withdrawn them.
                if self.session._files.writer is not None:
                    self.session._files.writer.close()
        if self.exit_code is None:
            self.exit_code = code

    def report(self, report: dict[str, Any]) -> None:
        self._reports.append(report)

    def reports(self) -> list[dict[str, Any]]:
        reports, self._reports = self._reports, []
        return reports

    def send(self, data: bytes) -> None:
        self.input.append(data)

    def close_stdin(self) -> None:
        self.is_closed = True

    def wait(self, timeout_s: float) -> int | None:
        self.world.turns.wait(lambda: self.exit_code is not None, timeout_s)
        return self.exit_code

    def kill(self) -> None:
        """Kill the child: its thread ends at its next turn, and what it has not done is not done."""
        if self.exit_code is None and not self.is_doomed:
            self.is_doomed = True
            if self.session is not None:
                self._announced = self.session._block["words"][ANNOUNCED].copy()
            if self.world.running is self:
                self.world.end_run("killed")
            if threading.current_thread() is self.thread:
                raise Killed
            self.world.turns.wait(lambda: self.exit_code is not None, 1.0)

    def end(self) -> bool:
        self.kill()
        return True

    def pause(self) -> None:
        """Wait until this child is to go on; raises Killed."""
        if self.is_doomed:
            raise Killed

    def _wait(self, condition: Callable[[], object]) -> None:
        self.world.turns.wait(lambda: self.is_doomed or self.is_closed or condition())
        self.pause()

    def _drive(self) -> int:
        """Run the plan that arrives, as `rtloop.engine.process` does."""
        world, board = self.world, self.world.board
        self._wait(lambda: self.input)
        if not self.input:
            return 0
        plan: Plan = pickle.loads(self.input.pop())
        block = SharedBlock(self.fd)
        world.turns.sleep(world.start_delay_s())
        self.pause()
        driver = BoardDriver(board)
        try:
            pointers = driver.open()
        except OSError as error:
            self.report({"report": "failed", "message": str(error), "exit_code": EXIT_CODES[Outcome.DRIVER_FAILED]})
            block.store(Word.LOOP_STATE, ProcessState.FAILED)
            return EXIT_CODES[Outcome.DRIVER_FAILED]
        context = clock_context(plan.pacing.rate_hz)
        clock = unpaced_clock(context, block.ring("ticks").head, block["words"], Word.RECORDER_CURSOR, FOR_EVER)
        self.assembly = Assembly(plan, block, driver.facts, pointers, clock, law_at_rest(plan))
        block.store(Word.LOOP_STATE, ProcessState.READY)
        self.report({"report": "ready", "realtime": {}})
        world.turns.wait(lambda: self.is_doomed or block.load(Word.GO) or block.load(Word.STOP))
        self.pause()
        self.outcome = Outcome.STOPPED
        if block.load(Word.GO):
            block.store(Word.START_UNIX_NS, round(1e9 * timing.unix_s()))
            block.store(Word.LOOP_STATE, ProcessState.RUNNING)
            self.outcome = Outcome.DONE
            world.begin_run(self, block)
            world.turns.wait(lambda: self.is_doomed or self.outcome is not Outcome.DONE)
            self.pause()
            block.store(Word.FINISHED_TICKS, self.assembly.loop.tick)
            world.end_run(self.outcome.name.lower())
        if self.assembly.loop.failed:
            block.fault = _fault_text(driver, self.assembly.loop)
        state, code = ProcessState.FINISHED, EXIT_CODES[self.outcome]
        try:
            ramp.ramp_to_safe(driver, pointers, self.assembly.outputs_v, plan.trip_slew_v_per_s)
            self.pause()
            self.report({"report": "finished", "outcome": self.outcome.name.lower(), "driver_error": block.fault})
            driver.close()
        except Exception as error:
            state, code = ProcessState.FAILED, EXIT_CODES[Outcome.DRIVER_FAILED]
            self.report({"report": "failed", "message": str(error), "exit_code": code})
        block.store(Word.LOOP_STATE, state)
        return code

    def _record(self) -> int:
        """Run the recorder on orders that arrive by `send`."""
        self._wait(lambda: os.pread(self.fd, 1, 0) == b"{")
        if self.is_closed:
            return 0
        return recorder.record_run(self.fd, None)


class ChildOrders:
    """Orders of the recorder whose thread reads them, in place of lines on stdin."""

    def __init__(self) -> None:
        self._child = World.present.child_of_thread()

    @property
    def is_closed(self) -> bool:
        return self._child.is_closed

    def next(self, wait_s: float | None = 0.0) -> Any:
        if wait_s is None:
            self._child._wait(lambda: self._child.input)
        self._child.pause()
        return json.loads(self._child.input.pop(0)) if self._child.input else None


class World:
    """One world: `text` is the service's configuration, `seed` the seed of interleavings and delays."""

    present: World

    def __init__(self, text: str, seed: int, board: Board, lock_timeout_s: float, preemption: float) -> None:
        World.present = self
        self._patch = pytest.MonkeyPatch()
        base = "/dev/shm" if os.path.isdir("/dev/shm") else None
        self._folder = tempfile.TemporaryDirectory(prefix="world-", dir=base)
        self.folder = Path(self._folder.name)
        self.config = self.folder / "lab.toml"
        self.config.write_text(text.replace("FOLDER", self._folder.name))
        self.random, self.preemption = random.Random(f"{seed} interleaving"), preemption
        self.turns = Turns(self._advance, choose=self.random.choice, delay=self._draw_delay)
        self.board, self.fds = board, set[int]()
        self.error: Exception | None = None
        self.loops: list[VirtualChild] = []
        self.recorders: list[VirtualChild] = []
        self.running: VirtualChild | None = None
        self.runs: list[Run] = []
        self.requests: list[Request] = []
        self.hangs_until_s = 0.0
        self.on_stretch: Callable[[Run, np.ndarray[Any, Any], np.ndarray[Any, Any]], None] = lambda *_: None
        self.on_begin: Callable[[], None] = lambda: None
        self._undone_ticks = 0.0
        self.disk_error: int | None = None
        self.cut_write: tuple[float, bool] | None = None
        """Share of its bytes that the next write writes, and whether the recorder dies then."""
        self._replace_processes(lock_timeout_s)
        self.service = Service(self.config)
        self._web = application(self.service)
        self.exit_code: int | None = None

    # The replacements

    def _replace_processes(self, lock_timeout_s: float) -> None:
        patch = self._patch
        patch.setattr(timing, "source", replace(virtual_time(self.turns), start_thread=self.start))
        patch.setenv("RUNTIME_DIRECTORY", str(self.folder / "run"))
        for module in (supervisor, recorder_keeper):
            patch.setattr(module, "Child", lambda *names, **files: VirtualChild(self, *names, **files))
        patch.setattr(supervisor, "Heart", lambda _: SimpleNamespace(watch=lambda: None, end=lambda: None))
        patch.setattr(Plan, "driver", lambda _: BoardDriver(self.board))
        patch.setattr(ramp, "_wait_until", lambda until_s: self.turns.sleep(max(until_s - self.turns.now_s, 0.0)))
        patch.setattr(ramp, "time", SimpleNamespace(monotonic=lambda: self.turns.now_s))
        patch.setattr(recorder, "SupervisorOrders", ChildOrders)
        patch.setattr(recorder, "_is_supervisor_gone", lambda: False)
        patch.setattr(recorder, "Session", self._make_session)
        patch.setattr(recorder, "print", lambda text, **_: self.child_of_thread().report(json.loads(text)), False)
        patch.setattr(building, "PROCESS", SimpleNamespace(run=self._build, prepare_ahead=lambda _: None))
        patch.setattr(service, "prepare", cached_prepare)
        patch.setattr(service, "POLL_S", 2 * STRETCH_S)
        patch.setattr(service, "SPARE_SAMPLES", 1 << 14)
        patch.setattr(service.SecondOpinion, "require", lambda *_: None)
        patch.setattr(service.SecondOpinion, "compute", lambda *_: None)
        patch.setattr(status, "timing", lambda _: {})
        patch.setattr(lock, "LOCK_TIMEOUT_S", lock_timeout_s)
        patch.setattr(Lanes, "run", lambda *arguments: run_in_lane(self.turns, *arguments))
        for name, method in (("__getitem__", SharedBlock.__getitem__), ("load", SharedBlock.load)):
            patch.setattr(SharedBlock, name, self._preempting(method))
        patch.setattr(lock.Lock, "_current_holder", self._preempting(lock.Lock._current_holder))
        send = desk.send
        patch.setattr(desk, "send", lambda *arguments, **options: self._send(send, *arguments, **options))
        self._pwrite, statvfs = os.pwrite, os.statvfs
        patch.setattr(os, "pwrite", self._write_file)
        patch.setattr(os, "fsync", lambda _: None)
        patch.setattr(os, "statvfs", lambda path: (statvfs(path), SimpleNamespace(f_bavail=1 << 40, f_frsize=1))[1])

    def _preempting(self, method: Callable[..., Any]) -> Callable[..., Any]:
        """Return a method after whose work the thread may lose its turn, as a thread of a real host may."""

        def call(*arguments: Any) -> Any:
            value = method(*arguments)
            self.turns.preempt()
            return value

        return call

    def _draw_delay(self) -> float:
        """Return the time for which a thread that could go on does not: mostly none."""
        if self.random.random() >= self.preemption:
            return 0.0
        return self.random.choice((1e-6, 1e-6, 0.0005, 0.002, 0.01, 0.05))

    def start_delay_s(self) -> float:
        return self.random.choice((0.0, 0.02, 0.1))

    def _make_session(self, *arguments: Any) -> session.Session:
        child = self.child_of_thread()
        child.session = session.Session(*arguments)
        return child.session

    def child_of_thread(self) -> VirtualChild:
        """Return the child for which the current thread works."""
        me = threading.current_thread()
        return next(child for child in self.recorders + self.loops if child.thread is me)

    def _build(self, function: Callable[..., Any], *arguments: Any, compiles: bool = False) -> Any:
        """Build a changed configuration as the limited process does, which takes a while."""
        self.turns.sleep(self.random.choice((0.01, 0.1, 0.4)))
        return cached_prepare(*arguments) if function is building.prepare else function(*arguments)

    def _send(self, send: Callable[..., int], block: SharedBlock, command: Any, **options: Any) -> int:
        number = request_number.get()
        run = next((run for run in self.runs if run.fd == block.fd), None)
        if number >= 0:
            self.requests[number].run = run
            is_urgent = options.get("urgent", False)
            sent = Command(int(command["kind"][0]), int(command["identity"][0]), self.turns.now_s,
                           0 if run is None else run.ticks, is_urgent)  # fmt: skip
            self.requests[number].commands.append(sent)
        usual, self.preemption = self.preemption, min(10 * self.preemption, 0.3)  # Two senders meet here, or nowhere.
        try:
            return send(block, command, **options)
        finally:
            self.preemption = usual
            self.turns.preempt()

    def _write_file(self, fd: int, data: Any, offset: int) -> int:
        """Write to the recorder's file: as a disk that is full, that fails, that writes less, or at death."""
        if fd in self.fds:
            return self._pwrite(fd, data, offset)
        if self.disk_error is not None:
            raise OSError(self.disk_error, os.strerror(self.disk_error))
        child = next((child for child in self.recorders if child.thread is threading.current_thread()), None)
        if self.cut_write is None or child is None:
            return self._pwrite(fd, data, offset)
        (share, kills), self.cut_write = self.cut_write, None
        written = self._pwrite(fd, data[: max(1, round(share * len(data)))], offset)
        if kills:
            child.kill()
        return written

    # Loops

    def begin_run(self, child: VirtualChild, block: SharedBlock) -> None:
        try:
            self.on_begin()
        except Exception as error:
            self.error = self.error or error
        self._rings = {name: block.ring(name) for name in ("ticks", "events")}
        self._cursors = {"ticks": 0, "events": 0}
        self.runs.append(Run(block.fd, self.turns.now_s))
        self._undone_ticks = 0.0
        self.running = child

    def end_run(self, outcome: str) -> None:
        self.runs[-1].outcome, self.runs[-1].ended_s, self.running = outcome, self.turns.now_s, None

    def _advance(self, seconds: float) -> None:
        """Execute the ticks of a stretch of time."""
        child, rate_hz = self.running, 1000.0
        if child is None or self.error or child.outcome is not Outcome.DONE or self.turns.now_s < self.hangs_until_s:
            return
        self._undone_ticks += seconds * rate_hz
        if (ticks := int(self._undone_ticks + 1e-6)) > 0:
            self._undone_ticks -= ticks
            child.outcome = child.assembly.run(int(child.assembly.loop.tick) + ticks)
            run = self.runs[-1]
            rows, events = self._drain("ticks"), self._drain("events")
            run.rows.append(rows)
            run.events.append(events)
            run.event_times_s += [self.turns.now_s] * len(events)
            try:
                self.on_stretch(run, rows, events)
            except Exception as error:  # The thread that passes its turn on is not at fault.
                self.error = self.error or error

    def _drain(self, name: str) -> np.ndarray[Any, Any]:
        """Return a copy of the new slots of a ring, which is not full after a stretch."""
        ring, first = self._rings[name], self._cursors[name]
        head = self._cursors[name] = int(ring.head[0])
        return ring.slots[np.arange(first, head) % len(ring.slots)]

    # Clients

    def request(
        self, client: str, method: str, path: str, body: Any = None, gone_after_s: float | None = None
    ) -> Request:
        """Send a request and return it with its answer; the client disconnects after `gone_after_s`."""
        request = Request(len(self.requests), client, method, path, body, self.turns.now_s)
        self.requests.append(request)
        token = request_number.set(request.number)
        resource = f"{path}?as={client}" if client else path
        data = body if isinstance(body, (bytes, type(None))) else json.dumps(body).encode()
        gone_s = float("inf") if gone_after_s is None else request.sent_s + gone_after_s
        try:
            is_gone: Callable[[], object] = lambda: self.turns.now_s >= gone_s
            code, headers, answer = answer_in_process(self._web, method, resource, data, None, is_gone)
        finally:
            request_number.reset(token)
        request.code, request.answered_s = code, self.turns.now_s
        request.answer = json.loads(answer) if "json" in headers.get("content-type", "") else answer.decode()
        return request

    def start(self, work: Callable[[], object]) -> threading.Thread:
        def guarded() -> None:
            try:
                work()
            except Exception as error:
                self.error = self.error or error

        return self.turns.start(guarded)

    def _serve(self) -> None:
        with run_recovery(self.service, self.service.recovery):
            self.exit_code = self.service.run()

    def live(self, actors: Sequence[Callable[[], object]], seconds: float) -> None:
        """Let the service run with its `actors` for some virtual time, then end it; raises what a thread raised."""
        serving = self.start(self._serve)
        threads = [self.start(actor) for actor in actors]
        end_s = self.turns.now_s + seconds
        self.turns.wait(lambda: self.error is not None, seconds)
        for thread in threads:
            self.turns.wait(lambda thread=thread: not thread.is_alive() or self.error is not None, 120.0)
        self.disk_error = None
        self.service.end()
        self.turns.wait(lambda: not serving.is_alive() or self.error is not None, 60.0)
        if self.error is not None:
            raise self.error
        assert not serving.is_alive(), f"the service does not end; end requested at {end_s}"

    def close(self) -> None:
        """End all threads and remove all files."""
        self.turns.end()
        self._patch.undo()
        for fd in self.fds:
            with contextlib.suppress(OSError):
                os.close(fd)
        self._folder.cleanup()

    def digest(self) -> str:
        """Return a hash over all records, events and answers."""
        digest = hashlib.sha256()
        for run in self.runs:
            for parts in (run.rows, run.events):
                for part in parts:
                    digest.update(part.tobytes())
        for request in self.requests:
            answer = request.answer
            if isinstance(answer, dict):
                answer = {key: value for key, value in answer.items() if key != "recording"}
            digest.update(repr((request.code, answer, request.answered_s)).encode())
        return digest.hexdigest()


_PREPARED: dict[str, Any] = {}


def cached_prepare(configuration: Configuration) -> Any:
    """Return `prepare(configuration)`; equal axes and options are prepared once."""
    key = repr((configuration.text, configuration.axes, configuration.folder))
    if key not in _PREPARED:
        _PREPARED[key] = prepare(configuration)
    return _PREPARED[key]
