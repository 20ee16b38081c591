"""Components: a service on a board that outlives it, from its start until it is ready, and from SIGTERM to its end.

Service and children are forked from a process with all modules imported: only calls of their work are tried. The trace
is that of the service's first thread, which starts and ends all others. Of repeated calls, which wait for others or
look for the versions of packages, a few are tried (`kinds.thinned`), and a few of the imports.

The next processes are `rtloop park`, then another service.
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
from tests.syscalls.serving import board, run_problems, serve, terminate
from tests.syscalls.traced import Injection, Outcome

NAME, UP_V, POLL_S, TIMEOUT_S = "lab", 1.0, 0.002, 40.0
WARM_TIMEOUT_S = 300.0
"""Long enough to compile all functions into an empty cache."""
HEARTBEAT_S = 0.5
LAST = 1_200
"""Number of characters at the end of a log that are printed."""


class StartingAService(Case):
    """A service from the begin of `serve` until it reports READY to systemd; then it gets SIGTERM."""

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
        self.unseen_step_v = board().output_record().largest_step_v

    def warm_up(self) -> None:
        """Serve once in a child, then import all of its modules here, so that later children find them imported."""
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
        """Park, start another service, and return the problems of board, logs and recordings."""
        problems = [] if outcome.crash else self._tracebacks(self.log)
        flushed = {path.name.removesuffix(".part"): ticks_on_disk([path]) for path in self.recordings.glob("*.mcap*")}
        written_ticks = self._flushed_ticks()
        if outcome.finished and not all(summarise(run).complete for run in runs_in(self.recordings)):
            problems.append("the service ends with 0, and a recording is not complete")
        try:
            parking.park_configuration(self.config)
        except (RtloopError, DriverError) as error:
            problems.append(f"the next process cannot park: {error}")
        problems += self._board_problems("parking")
        problems += self._next_start_problems()
        for name, ticks in flushed.items():
            if absent := ticks - (ticks_on_disk([path]) if (path := self.recordings / name).exists() else set()):
                problems.append(f"{name}: {len(absent)} flushed ticks are in no file")
        if written_ticks > (on_disk := len(ticks_on_disk([self.recordings / max(flushed)])) if flushed else 0):
            problems.append(f"{written_ticks} ticks are counted as written, {on_disk} are on the disk")
        problems += run_problems(self.recordings)
        return [*problems, *(self._log_tail(self.log) if problems else [])]

    def _flushed_ticks(self) -> int:
        """Return the number of ticks in files of the last run, as its recorder counts them in the shared block."""
        path = self.folder / "run" / f"{NAME}.block"
        if not path.exists() or not path.stat().st_size:
            return 0
        with suppress(ValueError), path.open("r+b") as file:  # the block has no directory yet
            block = SharedBlock(file.fileno())
            return block.load(Word.FLUSHED_TICKS) - block.load(Word.LOST_TICKS)
        return 0

    def _next_start_problems(self) -> list[str]:
        """Start another service in a child, end it once it is ready, and return its problems."""
        pid = os.fork()
        if pid == 0:
            self._serve_once(lambda: None)
        code = self._await(pid)
        problems = self._tracebacks(self.next_log) + self._board_problems("the next service")
        if code != 0:
            problems.append(f"the next service: {code}")
        return problems + (self._log_tail(self.next_log) if problems else [])

    def _board_problems(self, process: str) -> list[str]:
        """Return the problems of the board's output after `process`: an output that is not 0 V, a step too large."""
        bench = board()
        record = bench.output_record()
        problems = [] if record.last_v == 0.0 else [f"after {process} the output is at {record.last_v:.3f} V"]
        if record.largest_step_v > max(bench.bounds.step_v, self.unseen_step_v):
            problems.append(f"a step of {record.largest_step_v:.3f} V, allowed {bench.bounds.step_v:.3f} V")
        return problems

    def _serve_once(self, at_ready: Callable[[], object]) -> None:
        """Be a service that ends once it is ready, in this child process; never returns."""
        code = 1
        try:
            serve(self.config, self.next_log, at_ready=lambda: (at_ready(), terminate()))
            code = 0
        except (RtloopError, DriverError) as error:
            self.next_log.write_text(f"{self.next_log.read_text()}\n{error}")
        finally:
            os._exit(code)

    def _await(self, pid: int, timeout_s: float = TIMEOUT_S) -> int | str:
        """Return the exit code of a child, or a text for a child that had to be killed at the time-out."""
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
        """Return a problem if a log holds a traceback."""
        text = log.read_text() if log.exists() else ""
        return ["a traceback"] if "Traceback" in text else []

    def _log_tail(self, log: Path) -> list[str]:
        """Return the name and the end of a log, if the log exists."""
        return [f"{log.name}: {log.read_text()[-LAST:]}"] if log.exists() else []


class StoppingAService(StartingAService):
    """A service from SIGTERM, with the output up and ticks in the file, until it has ended."""

    def traced_work(self, logs: Path) -> None:
        threading.Thread(target=self._terminate_once_up, daemon=True).start()
        serve(self.config, self.log, at_stop=lambda: begin_here(logs))

    def _terminate_once_up(self) -> None:
        """Send SIGTERM once the output is up and ticks are in the file."""
        wait_for(lambda: board().output_record().last_v > UP_V, "an output that is up", TIMEOUT_S)
        wait_for(lambda: self._flushed_ticks() > 0, "ticks in the file", TIMEOUT_S)
        terminate()


class ImportingAService(StartingAService):
    """A service in a new interpreter, from the start of the interpreter until it reads its configuration.

    Its children are new interpreters too. It gets SIGTERM once it has reported READY to systemd.
    """

    def traced_work(self, logs: Path) -> None:
        os.dup2(os.open(self.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600), 2)
        begin_here(logs)
        os.execv(sys.executable, [sys.executable, "-m", "rtloop", "serve", str(self.config)])

    def trace(self, injection: Injection | None, logs: Path) -> Outcome:
        """Trace the service, send SIGTERM at READY, and keep only the calls before the configuration is read."""
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
        # An interpreter that cannot import prints a traceback before any code of rtloop runs: that counts as a crash.
        crash = outcome.crash or (self.log.read_text() if self._tracebacks(self.log) else "")
        return outcome._replace(calls=calls[:first], crash=crash)
