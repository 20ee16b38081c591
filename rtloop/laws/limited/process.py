"""A process beside this one in which somebody's own law runs first: one that does not come to an end is killed.

It is started with the first job, or ahead of it, and waits for the next one; a killed one is replaced by the next job.
It ends with this process. A job's time begins when all that it needs is imported and the compiler is loaded, and does
not pass while the process waits for a processor: the same law is not refused on a busy host.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import pickle
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rtloop.drivers.errors import DriverError
from rtloop.errors import ConfigError, RtloopError, UnavailableError
from rtloop.laws.limited.frames import LENGTH, write_frame
from rtloop.laws.limited.worker import PREPARE, RUN, Preparation

LIMIT_S = 10.0
"""A law that is not read, or not built and verified, within this is refused. The host's load does not count."""
START_S = 120.0
MAX_WAIT_FACTOR = 6.0
"""Times a limit, after which a process is given up however busy the host is."""
MAX_OUTPUT_BYTES = 1 << 16
"""Bytes that a law's code may print in a job."""


class AbandonedJob(UnavailableError):
    """A job did not come to an end, or its process died; `by_law` where the code of a law was running."""

    def __init__(self, message: str, by_law: bool) -> None:
        super().__init__(message)
        self.by_law = by_law


class LimitedProcess:
    """Runs one job at a time; thread-safe."""

    def __init__(self, limit_s: float = LIMIT_S) -> None:
        self.limit_s = limit_s
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._unanswered = 0
        """Preparations whose acknowledgement was not read yet."""
        self._data = bytearray()
        self._printed = bytearray()
        self._law: tuple[str, str] | None = None

    @property
    def pid(self) -> int | None:
        """Of its process; None where none runs."""
        return None if self._process is None else self._process.pid

    def prepare_ahead(self, function: Callable[..., Any]) -> None:
        """Start the process, and have it import `function`, without waiting for it; the first job tries again."""
        with self._lock, contextlib.suppress(OSError):
            self._start()
            self._prepare(function, compiles=False)

    def run(self, function: Callable[..., Any], *arguments: Any, compiles: bool = False, show: bool = True) -> Any:
        """What a function of a module returns; `show` what it prints, on stderr.

        Raises ConfigError and DriverError as the function does, ConfigError where a law's code raises anything else or
        leaves something running, GivenUp where it does not come to an end, or ends the process.
        """
        with self._lock:
            self._law = None
            self._printed.clear()
            try:
                self._start()
                self._prepare(function, compiles)
                while self._unanswered:
                    self._receive_message(_Clock(START_S, self.pid))
                    self._unanswered -= 1
                self._send(pickle.dumps((RUN, pickle.dumps(arguments))))
                kind, value = self._outcome()
            except BaseException:
                if self._law is None:
                    self._show_output()
                self.end()
                raise
            if kind == "leftover":
                self.end()
                raise ConfigError("law", [f"{self._culprit}{value}"])
            if show:
                self._show_output()
        if kind == "done":
            return pickle.loads(value)
        if kind == "faults":
            raise ConfigError(*value)
        raise DriverError(value) if kind == "driver" else RtloopError(value)

    def end(self) -> None:
        """Kill the process and all that a law started from it, if there is one."""
        if self._process is None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            if pipe is not None:
                with contextlib.suppress(OSError):  # nobody reads what was not sent
                    pipe.close()
        self._process = None

    def _start(self) -> None:
        if self._process is not None and self._process.poll() is None:
            return
        self.end()
        self._unanswered = 0
        self._data.clear()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rtloop.laws.limited.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            process_group=0,
            bufsize=0,
        )
        atexit.register(self.end)

    def _prepare(self, function: Callable[..., Any], compiles: bool) -> None:
        preparation = Preparation(os.getcwd(), sys.path, pickle.dumps(function), compiles, self.limit_s)
        self._send(pickle.dumps((PREPARE, tuple(preparation))))
        self._unanswered += 1

    def _send(self, data: bytes) -> None:
        assert self._process is not None
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it died: its answer does not come
            write_frame(self._process.stdin, data)

    def _outcome(self) -> tuple[str, Any]:
        """The answer to a job. Raises GivenUp."""
        clock = _Clock(self.limit_s, self.pid)
        while True:
            kind, value = self._receive_message(clock)
            if kind != "begins":
                self._read_output()
                return kind, value
            self._law = value

    def _receive_message(self, clock: _Clock) -> tuple[str, Any]:
        """The next message while there is time. Raises GivenUp."""
        assert self._process is not None
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        answers, printed = self._process.stdout.fileno(), self._process.stderr.fileno()
        while len(self._data) < LENGTH.size or len(self._data) < self._end_of_message:
            if (remaining_s := clock.remaining_s) <= 0:
                raise self._abandonment(f"took longer than {clock.limit_s:g} s and was given up")
            readable = select.select([answers, printed], [], [], remaining_s)[0]
            if printed in readable:
                self._add_output(os.read(printed, MAX_OUTPUT_BYTES))
            if answers in readable:
                part = os.read(answers, 1 << 20)
                if not part:
                    raise self._abandonment(f"ended its process ({self._exit_text()})")
                self._data += part
        end = self._end_of_message
        message = pickle.loads(self._data[LENGTH.size : end])
        del self._data[:end]
        return message

    @property
    def _end_of_message(self) -> int:
        return LENGTH.size + LENGTH.unpack_from(self._data)[0]

    def _read_output(self) -> None:
        """What was printed before the answer, and is still in the pipe. Raises GivenUp."""
        assert self._process is not None
        assert self._process.stderr is not None
        printed = self._process.stderr.fileno()
        while select.select([printed], [], [], 0)[0] and (part := os.read(printed, MAX_OUTPUT_BYTES)):
            self._add_output(part)

    def _show_output(self) -> None:
        sys.stderr.write(self._printed.decode(errors="replace"))

    def _add_output(self, part: bytes) -> None:
        self._printed += part
        if len(self._printed) > MAX_OUTPUT_BYTES:
            raise self._abandonment(f"printed more than {MAX_OUTPUT_BYTES >> 10} KiB")

    def _abandonment(self, reason: str) -> AbandonedJob:
        return AbandonedJob(f"{self._culprit or 'building the law: '}{reason}", self._law is not None)

    @property
    def _culprit(self) -> str:
        """The law whose code ran last, as a sentence begins; empty where none did."""
        return "" if self._law is None else "law {!r} ({}): ".format(*self._law)

    def _exit_text(self) -> str:
        assert self._process is not None
        code = self._process.wait(START_S)
        return f"exit code {code}" if code >= 0 else signal.Signals(-code).name


class _Clock:
    """Time that a process has had: what passed, less what it waited for a processor (proc(5), schedstat)."""

    def __init__(self, limit_s: float, pid: int | None) -> None:
        self.limit_s, self._file = limit_s, Path(f"/proc/{pid}/schedstat")
        self._begin_s, self._waited_before_s = time.monotonic(), self._waited_s

    @property
    def remaining_s(self) -> float:
        """Until the limit, if the process waits no longer."""
        passed_s, waited_s = time.monotonic() - self._begin_s, self._waited_s - self._waited_before_s
        return min(self.limit_s + waited_s, MAX_WAIT_FACTOR * self.limit_s) - passed_s

    @property
    def _waited_s(self) -> float:
        """For a processor since the process began; 0 where the kernel does not say, or the process has ended."""
        try:
            return int(self._file.read_text().split()[1]) / 1e9
        except (OSError, ValueError, IndexError):
            return 0.0


PROCESS = LimitedProcess()
"""The one beside this process."""
