"""A world: the real service, its API, supervisor, recorder, recovery and loop in one process, in virtual time.

Only processes are replaced: the child of a supervisor is a thread that takes turns. A board of simulated axes
outlives loops. All that happens is in `record`.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import random
import tempfile
import threading
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

import rtloop
from rtloop.configuration.file import Configuration
from rtloop.configuration.prepare import prepare
from rtloop.engine import ramp
from rtloop.engine.loop import Outcome
from rtloop.engine.memory import SharedBlock
from rtloop.engine.plan import Plan
from rtloop.foundation import timing
from rtloop.recording.capture import recorder, session
from rtloop.service import desk, lock, service, status
from rtloop.service.api.application import application
from rtloop.service.api.lanes import Lanes
from rtloop.service.changing import building
from rtloop.service.recovering.worker import run_recovery
from rtloop.service.service import Service
from rtloop.supervision import recorder_keeper, supervisor
from tests.virtual.bench import answer_in_process, run_in_lane
from tests.virtual.turns import Turns, virtual_time
from tests.worlds.board import Board, BoardDriver
from tests.worlds.child import ChildOrders, VirtualChild
from tests.worlds.schedule import Draw

STRETCH_S = 0.005
PACKAGE = Path(rtloop.__file__).parent
TRACED = [f"{PACKAGE / room}/" for room in ("service", "supervision", "recording/capture")]
"""Folders in whose lines a thread may lose its turn."""
for room in TRACED:  # What a module does when it is imported is not part of the first world that needs it.
    for file in Path(room).rglob("*.py"):
        import_module(".".join(("rtloop", *file.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__"))
request_number = ContextVar[int]("request_number", default=-1)
"""Number of the request for which a thread works; -1 for the service's own work."""


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


class World:
    """One world of a `draw`; `seed` is that of interleavings and delays."""

    def __init__(self, draw: Draw, seed: int, board: Board) -> None:
        self._patch = pytest.MonkeyPatch()
        base = "/dev/shm" if os.path.isdir("/dev/shm") else None
        self._folder = tempfile.TemporaryDirectory(prefix="world-", dir=base)
        self.folder = Path(self._folder.name)
        self.config = self.folder / "lab.toml"
        self.config.write_text(draw.text.replace("FOLDER", self._folder.name))
        self.random, self.preemption = random.Random(f"{seed} interleaving"), draw.preemption
        self._fine = draw.fine
        """Share of the lines of TRACED before which a thread loses its turn."""
        line_delay = self._draw_line_delay if draw.fine > 0 else None
        self.turns = Turns(self._advance, self.random.choice, self._draw_delay, line_delay, TRACED)
        self.turns.on_resume = self._end_doomed
        self.board, self.fds = board, set[int]()
        self.error: Exception | None = None
        self.loops: list[VirtualChild] = []
        self.recorders: list[VirtualChild] = []
        self.running: VirtualChild | None = None
        self.runs: list[Run] = []
        self.requests: list[Request] = []
        self.hangs_until_s = 0.0
        self.signals_s: list[float] = []
        """Times at which a signal requested a reload."""
        self.on_stretch: Callable[[Run, np.ndarray[Any, Any], np.ndarray[Any, Any]], None] = lambda *_: None
        self.on_begin: Callable[[], None] = lambda: None
        self._undone_ticks = 0.0
        self.disk_error: int | None = None
        self.cut_write: tuple[float, bool] | None = None
        """Share of its bytes that the next write writes, and whether the recorder dies then."""
        self._replace_processes(draw.lock_timeout_s)
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
        patch.setattr(recorder, "SupervisorOrders", lambda: ChildOrders(self.child_of_thread()))
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

    def _draw_line_delay(self) -> float:
        return self.random.choice((1e-6, 1e-6, 1e-6, 0.0005, 0.003, 0.02)) if self.random.random() < self._fine else 0.0

    def _end_doomed(self) -> None:
        """Raise Killed in the thread of a child that was killed while it had lost its turn."""
        me = threading.current_thread()
        for child in self.recorders + self.loops:
            if child.thread is me:
                child.pause()

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
