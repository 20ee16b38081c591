"""Parent side of the limited process, in which a user law runs first; the process is killed if the law does not return.

The process starts with the first job, or ahead of it, and then waits for the next job; a killed one is replaced at the
next job. It ends with its parent. The limit of a job begins when its imports are done and the compiler is loaded. It is
processor time: a busy host does not lead to a refusal."""

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
from typing import IO, Any, TypeVar

from rtloop.drivers.errors import DriverError
from rtloop.errors import ConfigError, RtloopError, UnavailableError
from rtloop.foundation.children import child_environment, python_command
from rtloop.foundation.processors import processor_time_s
from rtloop.laws.limited.frames import LENGTH, write_frame
from rtloop.laws.limited.worker import PREPARE, RUN, Preparation

LIMIT_S = 10.0
"""Processor time in which a law must be read, or built and verified, in seconds."""
START_S = 120.0
MAX_IDLE_FACTOR, MAX_FACTOR = 3.0, 60.0
"""Multiples of a limit after which a process is abandoned: of the time in which it neither computes nor waits for a
processor, and of all time, however busy the host is."""
LONGEST_SELECT_S, SHORTEST_SELECT_S = 1.0, 0.02
MAX_OUTPUT_BYTES = 1 << 16
"""Largest number of bytes that a law's code may print in a job."""
Result = TypeVar("Result")


class AbandonedJob(UnavailableError):
    """A job did not end, or its process died; `by_law` is True if the code of a law was running."""

    def __init__(self, message: str, by_law: bool) -> None:
        """Store the message, and whether the code of a law was running."""
        super().__init__(message)
        self.by_law = by_law


class LimitedProcess:
    """Limited process that runs one job at a time, each within `limit_s` seconds of processor time; thread-safe."""

    def __init__(self, limit_s: float = LIMIT_S) -> None:
        """Set the time limit of a job; the process starts with the first job, or with `prepare_ahead`."""
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
        """Number of the process, also after its death; None before its start and after `end`."""
        process = self._process  # Another thread may end it meanwhile.
        return None if process is None else process.pid

    def prepare_ahead(self, function: Callable[..., object]) -> None:
        """Start the process and have it import `function`, without waiting for it.

        An OSError is ignored: the first job tries again.
        """
        with self._lock, contextlib.suppress(OSError):
            self._start()
            self._prepare(function, compiles=False)

    def run(
        self, function: Callable[..., Result], *arguments: object, compiles: bool = False, show: bool = True
    ) -> Result:
        """Run a module-level function in the limited process and return its result.

        `show` writes its output to stderr; the output of a job that is abandoned while no law runs is always written.
        `compiles` loads the compiler first, outside the time limit.
        Raises ConfigError, DriverError or RtloopError if the function does; a subclass becomes one of these three.
        Raises ConfigError also if a law's code raises any other error, leaves a thread or process, or closes or
        replaces a standard stream, and for an ArithmeticError without a law. Raises AbandonedJob if the function does
        not return, prints too much, ends the process, or raises another error without a law; OSError if the system
        refuses the process. After AbandonedJob and after a leftover, the process has been killed, and the next job
        starts another.
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
        """Kill the process and its process group, in which a law may have started others; no effect if none runs.

        May be called from any thread, as at the exit of the program.
        """
        process, self._process = self._process, None
        if process is None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        for pipe in filter(None, (process.stdin, process.stdout, process.stderr)):
            with contextlib.suppress(OSError):  # the end of a dead process: unsent data is lost
                pipe.close()

    def _start(self) -> None:
        """Start the process if none runs; a dead one is replaced, and its messages and preparations are dropped.

        Raises OSError if the system refuses.
        """
        process = self._process
        if process is not None and process.poll() is None:
            return
        self.end()
        self._unanswered = 0
        self._data.clear()
        self._process = subprocess.Popen(
            python_command("rtloop.laws.limited.worker"),
            env=child_environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            process_group=0,
            bufsize=0,
        )
        atexit.register(self.end)

    def _prepare(self, function: Callable[..., object], compiles: bool) -> None:
        """Send the preparation of a job and count it in `_unanswered`; its acknowledgement is read later."""
        try:
            folder = os.getcwd()
        except FileNotFoundError:  # deleted meanwhile
            folder = "/"
        preparation = Preparation(folder, sys.path, pickle.dumps(function), compiles, self.limit_s)
        self._send(pickle.dumps((PREPARE, tuple(preparation))))
        self._unanswered += 1

    def _send(self, data: bytes) -> None:
        """Send a message; it is lost if the process has died."""
        with contextlib.suppress(BrokenPipeError):
            write_frame(self._pipes[0], data)

    @property
    def _pipes(self) -> tuple[IO[bytes], IO[bytes], IO[bytes]]:
        """Pipes to stdin and from stdout and stderr. Raises BrokenPipeError if no process runs."""
        process = self._process
        if process is None or process.stdin is None or process.stdout is None or process.stderr is None:
            raise BrokenPipeError("the helper process in which rtloop tries user laws has ended; try again")
        return process.stdin, process.stdout, process.stderr

    def _outcome(self) -> tuple[str, Any]:
        """Wait for the answer to a job; return its kind and value as `Worker._outcome` describes them.

        Stores the law announced last in `_law`, and collects all output of the job. Raises AbandonedJob if the job
        takes too long, prints too much or ends the process.
        """
        clock = _Clock(self.limit_s, self.pid)
        while True:
            kind, value = self._receive_message(clock)
            if kind != "begins":
                self._read_output()
                return kind, value
            self._law = value

    def _receive_message(self, clock: _Clock) -> tuple[str, Any]:
        """Wait for the next message, and collect output meanwhile. Returns kind and value of the message.

        Raises AbandonedJob if the limit passes, the process ends, or it prints too much.
        """
        answers, printed = (pipe.fileno() for pipe in self._pipes[1:])
        while len(self._data) < LENGTH.size or len(self._data) < self._end_of_message:
            remaining_s, is_by_law, excess = clock.verdict
            if remaining_s <= 0:
                raise self._abandonment(excess, is_by_law)
            wait_s = min(max(remaining_s, SHORTEST_SELECT_S), LONGEST_SELECT_S)
            readable = select.select([answers, printed], [], [], wait_s)[0]
            if printed in readable:
                self._add_output(os.read(printed, MAX_OUTPUT_BYTES))
            if answers in readable:
                part = os.read(answers, 1 << 20)
                if not part:
                    correction = "correct the code, which exits, crashes or exhausts the memory"
                    remedy = "try again" if self._law is None else correction
                    raise self._abandonment(f"the process that runs this code ended ({self._exit_text()}); {remedy}")
                self._data += part
        end = self._end_of_message
        message = pickle.loads(self._data[LENGTH.size : end])
        del self._data[:end]
        return message

    @property
    def _end_of_message(self) -> int:
        """End of the first message in the received data, in bytes; its length field must have been received."""
        return LENGTH.size + LENGTH.unpack_from(self._data)[0]

    def _read_output(self) -> None:
        """Collect the output that is still in the pipe. Raises AbandonedJob if it is too much."""
        printed = self._pipes[2].fileno()
        while select.select([printed], [], [], 0)[0] and (part := os.read(printed, MAX_OUTPUT_BYTES)):
            self._add_output(part)

    def _show_output(self) -> None:
        """Write the collected output of the job to stderr; it stays collected until the next job."""
        sys.stderr.write(self._printed.decode(errors="replace"))

    def _add_output(self, part: bytes) -> None:
        """Append to the collected output. Raises AbandonedJob if it is too much."""
        self._printed += part
        if len(self._printed) > MAX_OUTPUT_BYTES:
            raise self._abandonment(f"the code printed more than {MAX_OUTPUT_BYTES >> 10} KiB; let it print less")

    def _abandonment(self, reason: str, is_by_law: bool = True) -> AbandonedJob:
        """Return the error that names the running law, if there is one, and `reason`, which is the law's unless
        `is_by_law` is False.
        """
        return AbandonedJob(f"{self._culprit or 'building the law: '}{reason}", is_by_law and self._law is not None)

    @property
    def _culprit(self) -> str:
        """Beginning of a message that names the law whose code ran last in the job; "" if no law's code ran."""
        return "" if self._law is None else "law {!r} ({}): ".format(*self._law)

    def _exit_text(self) -> str:
        """Return "exit code N" of the ended process, or the name of the signal that killed it."""
        process = self._process
        code = -signal.SIGKILL if process is None else process.wait(START_S)
        return f"exit code {code}" if code >= 0 else signal.Signals(-code).name


class _Clock:
    """Times of a process since the clock was made: processor time, time waited for a processor (proc(5), schedstat),
    and the rest, in which it sleeps or waits for something else.
    """

    def __init__(self, limit_s: float, pid: int | None) -> None:
        """Begin to count the times of process `pid`, against a limit of `limit_s` of processor time."""
        self.limit_s, self._pid, self._file = limit_s, pid or 0, Path(f"/proc/{pid}/schedstat")
        self._begin = self._times_s

    @property
    def verdict(self) -> tuple[float, bool, str]:
        """Return the time until the next limit, in s, 0 or less after it; whether that limit blames the code; and what
        the process did beyond the limit.
        """
        passed_s, computed_s, waited_s = (
            now_s - begin_s for now_s, begin_s in zip(self._times_s, self._begin, strict=True)
        )
        idle_limit_s, longest_s = MAX_IDLE_FACTOR * self.limit_s, MAX_FACTOR * self.limit_s
        return min(
            (
                self.limit_s - computed_s,
                True,
                f"the code used more than {self.limit_s:g} s of processor time and was stopped; make it faster, or "
                "correct a loop that does not end",
            ),
            (
                idle_limit_s - (passed_s - computed_s - waited_s),
                True,
                f"the code was stopped, because for {idle_limit_s:g} s it did not compute; correct code that sleeps, "
                "or waits for a file, a lock or another process",
            ),
            (
                longest_s - passed_s,
                False,
                f"the code had only {computed_s:.2g} s of processor time within {longest_s:g} s, because the host is "
                "too busy, and was stopped; try again on a quieter host",
            ),
        )

    @property
    def _times_s(self) -> tuple[float, float, float]:
        """Time of a monotonic clock, processor time of all threads, and time waited for a processor, in s; the last two
        are 0 if they are unknown or the process has ended.
        """
        return time.monotonic(), processor_time_s(self._pid), self._waited_s

    @property
    def _waited_s(self) -> float:
        """Time that the main thread has waited for a processor, in s; 0 if unknown or the process has ended."""
        try:
            return int(self._file.read_text().split()[1]) / 1e9
        except (OSError, ValueError, IndexError):
            return 0.0


PROCESS = LimitedProcess()
"""The limited process of this process."""
