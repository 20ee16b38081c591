"""Children of the supervisor in a world: threads that take turns, in place of the processes of loop and recorder."""

from __future__ import annotations

import json
import os
import pickle
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rtloop.engine import ramp
from rtloop.engine.assembly import Assembly, law_at_rest
from rtloop.engine.clock import clock_context, unpaced_clock
from rtloop.engine.loop import Outcome
from rtloop.engine.memory import ProcessState, SharedBlock, Word
from rtloop.engine.plan import Plan
from rtloop.engine.process import EXIT_CODES, _fault_text
from rtloop.foundation import timing
from rtloop.recording.capture import progress, recorder, session
from rtloop.supervision import recorder_keeper
from tests.worlds.board import BoardDriver

if TYPE_CHECKING:
    from tests.worlds.world import World

FOR_EVER = 1 << 62
KILLED = -9
ANNOUNCED = [int(word) for word in (*progress.ANNOUNCED, Word.ANNOUNCED_BYTE)]


class Killed(BaseException):
    """The process that this thread stands for was killed."""


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
            with self.world.turns.undivided():
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
            with self.world.turns.undivided():
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

    def __init__(self, child: VirtualChild) -> None:
        self._child = child

    @property
    def is_closed(self) -> bool:
        return self._child.is_closed

    def next(self, wait_s: float | None = 0.0) -> Any:
        if wait_s is None:
            self._child._wait(lambda: self._child.input)
        self._child.pause()
        return json.loads(self._child.input.pop(0)) if self._child.input else None
