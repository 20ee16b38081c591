"""A forked process that works under strace, which makes one of its system calls fail or kills the process there.

The parent has imported all modules before: the child makes only the calls of the work. strace is attached before the
work begins; the ordinals of calls are counted from there, separately for each name.
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
"""Bytes at the end of a trace that hold at least its last line."""


class EndedTooEarly(Exception):
    """The work ended before its trace began, as when a stalled host trips a loop."""


class Call(NamedTuple):
    """A system call of the work: its name, its ordinal by name since the attachment, and its line in the trace."""

    name: str
    ordinal: int
    line: str = ""

    def __str__(self) -> str:
        return f"{self.name} #{self.ordinal}"


class Injection(NamedTuple):
    """An injection at a call; `kind` is an error by its name (`EIO`), KILLED_BEFORE or KILLED_AFTER."""

    call: Call
    kind: str

    @property
    def options(self) -> list[str]:
        """Arguments of strace for this injection."""
        act = {KILLED_BEFORE: "signal=SIGKILL", KILLED_AFTER: f"delay_exit={_FOREVER_US}"}.get(self.kind)
        return [f"--inject={self.call.name}:{act or f'error={self.kind}'}:when={self.call.ordinal}"]

    def __str__(self) -> str:
        return f"{self.kind} at {self.call}"


class Outcome(NamedTuple):
    """End of the work: `killed`, or with `refusal` (message of an error of rtloop) or `crash` (a traceback)."""

    calls: list[Call]
    reached: bool
    killed: bool
    refusal: str
    crash: str
    hung: bool

    @property
    def finished(self) -> bool:
        """Whether the work ended without an error."""
        return not (self.killed or self.refusal or self.crash)


@cache
def unavailable() -> str:
    """Return the reason why this host cannot trace system calls; empty if it can."""
    if shutil.which("strace") is None:
        return "strace is not installed (make tools)"
    done = subprocess.run(["strace", "-o", "/dev/null", "true"], capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else f"ptrace is not permitted: {done.stderr.strip()}"


class Traced:
    """A forked child with strace attached to one of its threads; `begin` starts the work.

    `folder` receives the trace and the error. `prepare` is called in the child before strace is attached; None: the
    work calls `begin_here` in the thread to trace, where the trace shall begin.
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
        """Send GO, which starts the work."""
        os.kill(self.pid, GO)

    def exit_code(self) -> int | None:
        """Return the exit code as in subprocess, or None while the process runs; this method kills for KILLED_AFTER."""
        with self._lock:
            if self._status is None:
                if self._injection and self._injection.kind == KILLED_AFTER and self._is_delayed():
                    os.kill(self.pid, signal.SIGKILL)
                    self._strace.kill()  # strace sleeps, and the kernel reports the child's end to strace first
                pid, status = os.waitpid(self.pid, os.WNOHANG)
                self._status = os.waitstatus_to_exitcode(status) if pid else None
            return self._status

    def wait(self, timeout_s: float = _TIMEOUT_S) -> Outcome:
        """Wait for the end and return the outcome; a process that hangs is killed and counts as a crash."""
        deadline_s, hang = time.monotonic() + timeout_s, ""
        while self.exit_code() is None:
            if time.monotonic() > deadline_s and not hang:
                hang = f"the process hung for {timeout_s:g} s"
                os.kill(self.pid, signal.SIGKILL)
            time.sleep(_POLL_S)
        self._strace.communicate()
        code, error = self.exit_code(), self._error.read_text() if self._error.exists() else ""
        killed = code == -signal.SIGKILL and not hang
        crash = hang or (error if code not in (CLEAR, REFUSED) and not killed else "")
        if not crash and not killed and code not in (CLEAR, REFUSED):
            crash = f"exit code {code}"
        text = self._trace()
        return Outcome(
            _calls(text), self._is_reached(text, killed), killed, error if code == REFUSED else "", crash, bool(hang)
        )

    def kill(self) -> None:
        """Kill the process if it still runs."""
        with self._lock:
            if self._status is None:
                os.kill(self.pid, signal.SIGKILL)

    def _is_reached(self, text: str, killed: bool) -> bool:
        """Return whether the injection took place."""
        if self._injection is None:
            return True
        return killed if self._injection.kind in (KILLED_BEFORE, KILLED_AFTER) else "(INJECTED)" in text

    def _await_attachment(self) -> None:
        """Wait until the kernel names strace as the tracer of the thread."""
        deadline_s, mark = time.monotonic() + _TIMEOUT_S, f"TracerPid:\t{self._strace.pid}\n"
        while mark not in Path(f"/proc/{self.pid}/task/{self._thread}/status").read_text():
            if self._strace.poll() is not None or time.monotonic() > deadline_s:
                os.kill(self.pid, signal.SIGKILL)
                raise RuntimeError(f"strace cannot attach: {self._strace.communicate()[1].decode()}")
            time.sleep(_POLL_S)

    def _is_delayed(self) -> bool:
        """Return whether strace holds the child after its call."""
        if not self._log.exists():
            return False
        with self._log.open("rb") as file:
            file.seek(max(self._log.stat().st_size - _LAST_BYTES, 0))
            return b"(DELAYED)" in file.read()

    def _trace(self) -> str:
        return self._log.read_text(errors="replace") if self._log.exists() else ""


def _calls(text: str) -> list[Call]:
    """Return the calls between the marks BEGIN and END of a trace."""
    counts, calls, inside = Counter[str](), [], False
    for line in text.splitlines():
        match = _LINE.match(line)
        if match is None:
            continue
        counts[match[1]] += 1
        if END in line:
            break
        if inside:
            calls.append(Call(match[1], counts[match[1]], line))
        inside = inside or BEGIN in line
    return calls
