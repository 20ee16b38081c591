"""A service on a board that outlives it, from its start until it is ready, and from the stop signal to its end.

The service is forked from what has imported everything, and its children are too: the calls that are tried are those
of its work. Its first thread is traced, which starts and ends all else. Of what it does again and again, waiting for
others or looking for the versions of packages, a few calls are tried (`kinds.thinned`), and a few of its imports.

The next hands are `rtloop park`, then another service.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.drivers.errors import DriverError
from rtloop.engine.assembly import rehearse
from rtloop.engine.memory import SharedBlock, Word
from rtloop.errors import RtloopError
from rtloop.recording.views.summary import summarise
from rtloop.supervision import parking
from tests.faults.account import runs_in
from tests.faults.configuration import on_a_board
from tests.faults.evidence import wait_for
from tests.syscalls.component import Case
from tests.syscalls.marked import begin_here, end_here
from tests.syscalls.recordings import ticks_on_disk
from tests.syscalls.serving import board, problems_of_runs, serve, terminate
from tests.syscalls.traced import Injection, Outcome

NAME, UP_V, POLL_S, TIMEOUT_S = "lab", 1.0, 0.002, 40.0
WARM_TIMEOUT_S = 300.0
"""What is not in the cache is compiled first."""
HEARTBEAT_S = 0.5
LAST = 1_200
"""Characters of a log."""


class StartingAService(Case):
    """From the beginning of `serve` until systemd is told that it is ready; then it is told to end."""

    is_all_traced = False
    may_crash = True

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        text = on_a_board(folder, ("[loop]\n", f"[loop]\nheartbeat_timeout_s = {HEARTBEAT_S}\n"))
        self.config = folder / f"{NAME}.toml"
        self.config.write_text(text.replace(f"{folder}/board", f"{board().folder}/board"))
        self.log, self.next_log, self.recordings = folder / "log", folder / "next-log", folder / "recordings"
        os.environ["RUNTIME_DIRECTORY"] = str(folder / "run")
        os.environ["NOTIFY_SOCKET"] = str(folder / "notify")
        self.unseen_step_v = board().seen().largest_step_v

    def warm_up(self) -> None:
        """Import, load and compile here what a service and its children do, and serve once."""
        prepare(load(self.config))
        rehearse()
        names = self.folder / "imported"
        pid = os.fork()
        if pid == 0:
            self._serve_once(lambda: names.write_text("\n".join(sorted(sys.modules))))
        self._await(pid, WARM_TIMEOUT_S)
        for name in names.read_text().split():
            if name.partition(".")[0] not in ("__main__", "__mp_main__"):
                __import__(name)

    def traced_work(self, logs: Path) -> None:
        serve(self.config, self.log, lambda: begin_here(logs), lambda: (end_here(), terminate()))

    def judge(self, outcome: Outcome) -> list[str]:
        problems = [] if outcome.crash else self._tracebacks(self.log)
        flushed = {path.name.removesuffix(".part"): ticks_on_disk([path]) for path in self.recordings.glob("*.mcap*")}
        written = self._written()
        if outcome.finished and not all(summarise(run).complete for run in runs_in(self.recordings)):
            problems.append("the service ends with 0, and a recording is not complete")
        try:
            parking.park_configuration(self.config)
        except (RtloopError, DriverError) as error:
            problems.append(f"the next hand cannot park: {error}")
        problems += self._problems_of_the_board("parking")
        problems += self._problems_of_the_next_start()
        for name, ticks in flushed.items():
            if absent := ticks - (ticks_on_disk([path]) if (path := self.recordings / name).exists() else set()):
                problems.append(f"{name}: {len(absent)} flushed ticks are in no file")
        if written > (there := len(ticks_on_disk([self.recordings / max(flushed)])) if flushed else 0):
            problems.append(f"{written} ticks are said to be written, {there} are there")
        problems += problems_of_runs(self.recordings)
        return [*problems, *(self._log_of(self.log) if problems else [])]

    def _written(self) -> int:
        """Ticks of the last run that are in files, as its recorder says in the shared block."""
        path = self.folder / "run" / f"{NAME}.block"
        if not path.exists() or not path.stat().st_size:
            return 0
        with suppress(ValueError), path.open("r+b") as file:  # there is no directory in it yet
            block = SharedBlock(file.fileno())
            return block.load(Word.FLUSHED_TICKS) - block.load(Word.LOST_TICKS)
        return 0

    def _problems_of_the_next_start(self) -> list[str]:
        pid = os.fork()
        if pid == 0:
            self._serve_once(lambda: None)
        code = self._await(pid)
        problems = self._tracebacks(self.next_log) + self._problems_of_the_board("the next service")
        if code != 0:
            problems.append(f"the next service: {code}")
        return problems + (self._log_of(self.next_log) if problems else [])

    def _problems_of_the_board(self, hand: str) -> list[str]:
        bench = board()
        seen = bench.seen()
        problems = [] if seen.last_v == 0.0 else [f"after {hand} the output is at {seen.last_v:.3f} V"]
        if seen.largest_step_v > max(bench.bounds.step_v, self.unseen_step_v):
            problems.append(f"a step of {seen.largest_step_v:.3f} V, allowed {bench.bounds.step_v:.3f} V")
        return problems

    def _serve_once(self, at_ready: Callable[[], object]) -> None:
        """As another service does that is told to end once it is ready; never returns."""
        code = 1
        try:
            serve(self.config, self.next_log, at_ready=lambda: (at_ready(), terminate()))
            code = 0
        except (RtloopError, DriverError) as error:
            self.next_log.write_text(f"{self.next_log.read_text()}\n{error}")
        finally:
            os._exit(code)

    def _await(self, pid: int, timeout_s: float = TIMEOUT_S) -> int | str:
        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            done, status = os.waitpid(pid, os.WNOHANG)
            if done:
                return os.waitstatus_to_exitcode(status)
            time.sleep(POLL_S)
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        return f"hung for {timeout_s:g} s"

    def _tracebacks(self, log: Path) -> list[str]:
        text = log.read_text() if log.exists() else ""
        return ["a traceback"] if "Traceback" in text else []

    def _log_of(self, log: Path) -> list[str]:
        return [f"{log.name}: {log.read_text()[-LAST:]}"] if log.exists() else []


class StoppingAService(StartingAService):
    """From SIGTERM, with the output up and ticks in the file, until the service has ended."""

    def traced_work(self, logs: Path) -> None:
        threading.Thread(target=self._terminate_once_up, daemon=True).start()
        serve(self.config, self.log, at_stop=lambda: begin_here(logs))

    def _terminate_once_up(self) -> None:
        wait_for(lambda: board().seen().last_v > UP_V, "an output that is up", TIMEOUT_S)
        wait_for(lambda: self._written() > 0, "ticks in the file", TIMEOUT_S)
        terminate()


class ImportingAService(StartingAService):
    """A service as a user starts it, from the beginning of its interpreter until it reads its configuration.

    Its children are interpreters of their own. It is told to end once systemd is told that it is ready.
    """

    def traced_work(self, logs: Path) -> None:
        os.dup2(os.open(self.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600), 2)
        begin_here(logs)
        os.execv(sys.executable, [sys.executable, "-m", "rtloop", "serve", str(self.config)])

    def trace(self, injection: Injection | None, logs: Path) -> Outcome:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
            manager.bind(os.environ["NOTIFY_SOCKET"])
            manager.settimeout(POLL_S)
            traced = self.traced(injection, logs)
            traced.begin()
            while traced.exit_code() is None:
                with suppress(TimeoutError):
                    if b"READY=1" in manager.recv(4096):
                        os.kill(traced.pid, signal.SIGTERM)
            outcome = traced.wait()
        calls = outcome.calls[1:]  # without the `execve` of the test
        first = next(
            (at for at, call in enumerate(calls) if f"{self.folder.name}/{self.config.name}" in call.line), None
        )
        # an interpreter that cannot import says so by a traceback, before there is anything of rtloop
        crash = outcome.crash or (self.log.read_text() if self._tracebacks(self.log) else "")
        return outcome._replace(calls=calls[:first], crash=crash)
