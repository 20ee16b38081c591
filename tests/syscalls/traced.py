"""A forked process that does some work under strace, which fails one of its system calls or is the last to see it.

The parent has imported everything before: the child makes only the calls of the work. strace is attached before the
work begins, so that the ordinal of a call counts from there, by the name of the call.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

from tests.syscalls.marked import BEGIN, CLEAR, END, GO, PREPARED, REFUSED, work_and_exit

KILLED_BEFORE, KILLED_AFTER = "killed before", "killed after"
_LINE = re.compile(r"(\w+)\(")
_FOREVER_US, _POLL_S, _TIMEOUT_S = 600_000_000, 0.001, 60.0
_LAST_BYTES = 400
"""Of a trace: at least its last line."""


class EndedTooEarly(Exception):
    """The work ended before its trace began: a host that stands still for seconds trips a loop."""


class Call(NamedTuple):
    """A system call of the work: its name, its ordinal by name since the attachment, and its line in the trace."""

    name: str
    ordinal: int
    line: str = ""

    def __str__(self) -> str:
        return f"{self.name} #{self.ordinal}"


class Injection(NamedTuple):
    """What happens at a call: an error by its name (`EIO`), KILLED_BEFORE or KILLED_AFTER."""

    call: Call
    kind: str

    @property
    def options(self) -> list[str]:
        """Arguments for strace."""
        act = {KILLED_BEFORE: "signal=SIGKILL", KILLED_AFTER: f"delay_exit={_FOREVER_US}"}.get(self.kind)
        return [f"--inject={self.call.name}:{act or f'error={self.kind}'}:when={self.call.ordinal}"]

    def __str__(self) -> str:
        return f"{self.kind} at {self.call}"


class Outcome(NamedTuple):
    """How the work ended: `killed`, or with `refusal` (message of an error of rtloop) or `crash` (a traceback)."""

    calls: list[Call]
    reached: bool
    killed: bool
    refusal: str
    crash: str
    hung: bool

    @property
    def finished(self) -> bool:
        """Whether the work came to its end without an error."""
        return not (self.killed or self.refusal or self.crash)


@cache
def unavailable() -> str:
    """Why system calls cannot be traced here; empty where they can."""
    if shutil.which("strace") is None:
        return "strace is not installed (make tools)"
    done = subprocess.run(["strace", "-o", "/dev/null", "true"], capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else f"ptrace is not permitted: {done.stderr.strip()}"


class Traced:
    """Forks, and attaches strace to the thread that says it is ready; `begin` lets the work go.

    `folder` receives the trace and the error. `prepare` is done in the child before strace is attached; None: the work
    says by itself, by `begin_here`, which of its threads is traced from where on.
    """

    def __init__(
        self,
        work: Callable[[], object],
        folder: Path,
        injection: Injection | None = None,
        prepare: Callable[[], object] | None = lambda: None,
    ) -> None:
        self._log, self._error, self._injection = folder / "trace", folder / "error", injection
        prepared = folder / PREPARED
        for path in (self._log, self._error, prepared):
            path.unlink(missing_ok=True)
        self._lock, self._status = threading.Lock(), None
        signal.pthread_sigmask(signal.SIG_BLOCK, [GO])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            self.pid = os.fork()
        if self.pid == 0:
            work_and_exit(prepare, work, self._error)
        while not prepared.exists():
            if self.exit_code() is not None:
                error = self._error.read_text() if self._error.exists() else f"exit code {self._status}"
                raise EndedTooEarly(f"the work ended before it was traced: {error}")
            time.sleep(_POLL_S)
        self._thread = int(prepared.read_text())
        options = injection.options if injection else []
        command = [
            "strace",
            "-q",
            "-s",
            "64",
            "-e",
            "signal=none",
            "-o",
            str(self._log),
            "-p",
            str(self._thread),
            *options,
        ]
        self._strace = subprocess.Popen(command, stderr=subprocess.PIPE)
        self._await_attachment()

    def begin(self) -> None:
        """Let the work go."""
        os.kill(self.pid, GO)

    def exit_code(self) -> int | None:
        """Exit code as in subprocess, or None while it runs; a call with KILLED_AFTER is killed from here."""
        with self._lock:
            if self._status is None:
                if self._injection and self._injection.kind == KILLED_AFTER and self._is_delayed():
                    os.kill(self.pid, signal.SIGKILL)
                    self._strace.kill()  # it sleeps, and the child's end is first reported to it
                pid, status = os.waitpid(self.pid, os.WNOHANG)
                self._status = os.waitstatus_to_exitcode(status) if pid else None
            return self._status

    def wait(self, timeout_s: float = _TIMEOUT_S) -> Outcome:
        """Wait for the end; a process that does not end in time is killed, and its outcome is a crash."""
        deadline_s, late = time.monotonic() + timeout_s, ""
        while self.exit_code() is None:
            if time.monotonic() > deadline_s and not late:
                late = f"it hung for {timeout_s:g} s"
                os.kill(self.pid, signal.SIGKILL)
            time.sleep(_POLL_S)
        self._strace.communicate()
        code, error = self.exit_code(), self._error.read_text() if self._error.exists() else ""
        killed = code == -signal.SIGKILL and not late
        crash = late or (error if code not in (CLEAR, REFUSED) and not killed else "")
        if not crash and not killed and code not in (CLEAR, REFUSED):
            crash = f"exit code {code}"
        text = self._text()
        return Outcome(
            _calls(text), self._is_reached(text, killed), killed, error if code == REFUSED else "", crash, bool(late)
        )

    def kill(self) -> None:
        """End the process if it still runs."""
        with self._lock:
            if self._status is None:
                os.kill(self.pid, signal.SIGKILL)

    def _is_reached(self, text: str, killed: bool) -> bool:
        """Whether the injection came about."""
        if self._injection is None:
            return True
        return killed if self._injection.kind in (KILLED_BEFORE, KILLED_AFTER) else "(INJECTED)" in text

    def _await_attachment(self) -> None:
        deadline_s, mark = time.monotonic() + _TIMEOUT_S, f"TracerPid:\t{self._strace.pid}\n"
        while mark not in Path(f"/proc/{self.pid}/task/{self._thread}/status").read_text():
            if self._strace.poll() is not None or time.monotonic() > deadline_s:
                os.kill(self.pid, signal.SIGKILL)
                raise RuntimeError(f"strace cannot attach: {self._strace.communicate()[1].decode()}")
            time.sleep(_POLL_S)

    def _is_delayed(self) -> bool:
        """Whether strace holds the child behind the call."""
        if not self._log.exists():
            return False
        with self._log.open("rb") as file:
            file.seek(max(self._log.stat().st_size - _LAST_BYTES, 0))
            return b"(DELAYED)" in file.read()

    def _text(self) -> str:
        return self._log.read_text(errors="replace") if self._log.exists() else ""


def _calls(text: str) -> list[Call]:
    """The calls between the marks of a trace."""
    seen, calls, inside = Counter[str](), [], False
    for line in text.splitlines():
        match = _LINE.match(line)
        if match is None:
            continue
        seen[match[1]] += 1
        if END in line:
            break
        if inside:
            calls.append(Call(match[1], seen[match[1]], line))
        inside = inside or BEGIN in line
    return calls
