"""Child side of the limited process: runs one function after the other, reports which law's code runs, and the outcome.

A job is two messages: the preparation (function, imports, compiler), which is acknowledged; then the arguments, with
which the code of a law may begin to run. A preparation may come ahead of an expected job. Every exception of a job
becomes an answer if a law was announced before it, also SystemExit and KeyboardInterrupt; without a law, only rtloop's
errors and ArithmeticError do, and any other ends the process. Output goes to stderr, which the parent reads."""

from __future__ import annotations

import _thread
import os
import pickle
import signal
import sys
import traceback
from collections.abc import Callable
from difflib import get_close_matches
from typing import IO, NamedTuple

from rtloop.drivers.errors import DriverError
from rtloop.errors import ConfigError, RtloopError
from rtloop.laws.limited.announcement import listen
from rtloop.laws.limited.frames import read_frame, write_frame

SPARE_S = 5.0
"""Processor time in s beyond the limit after which the process ends itself, in case its parent was killed."""
PREPARE, RUN = "prepare", "run"
"""Kinds of messages: with a `Preparation`, and with the pickled arguments."""
STREAMS = {0: "stdin", 1: "stdout", 2: "stderr"}


class Preparation(NamedTuple):
    """First message of a job to its worker process.

    Folder and module search path of the parent, the pickled function, whether it needs the compiler, and the limit.
    """

    folder: str
    module_folders: list[str]
    function: bytes
    compiles: bool
    limit_s: float


class Worker:
    """Answers jobs until the pipe is closed."""

    def __init__(self, jobs: IO[bytes], answers: IO[bytes]) -> None:
        """Make this process a limited one, which reads jobs from one pipe and answers on the other."""
        self._jobs, self._answers = jobs, answers
        self._pid = os.getpid()
        self._law: tuple[str, str] | None = None
        listen(self._announce)

    def work(self) -> None:
        """Process jobs until the parent ends or closes its pipe. Arguments belong to the latest preparation."""
        function: Callable[..., object] = _identity
        limit_s = 0.0
        while (data := read_frame(self._jobs)) is not None:
            kind, content = pickle.loads(data)
            if kind == PREPARE:
                preparation = Preparation(*content)
                function, limit_s = self._prepare(preparation), preparation.limit_s
                continue
            self._law = None
            signal.setitimer(signal.ITIMER_PROF, limit_s + SPARE_S)
            outcome = self._outcome(function, content)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            self._answer(*outcome)

    def _prepare(self, preparation: Preparation) -> Callable[..., object]:
        """Set folder and module path, load a job's function and all that it needs, acknowledge; return the function."""
        os.chdir(preparation.folder)
        sys.path[:] = preparation.module_folders
        function = pickle.loads(preparation.function)
        if preparation.compiles:
            _load_compiler()
        self._answer("ready", None)
        return function

    def _outcome(self, function: Callable[..., object], arguments: bytes) -> tuple[str, object]:
        """Run the function; return kind and value of the answer: "done" with the pickled result, or as `_failure` does.

        "leftover" with a message if a law's code left a thread or process, or replaced or closed a standard stream.
        """
        threads = _thread._count()
        streams = _streams()
        try:
            kind, value = "done", pickle.dumps(function(*pickle.loads(arguments)))
        except BaseException as error:
            kind, value = self._failure(error)
        if os.getpid() != self._pid:
            os._exit(0)  # a copy of this process that the law's code made; the law is refused for it below
        if self._law is not None and (fault := _leftover_fault(threads, streams)):
            return "leftover", fault
        return kind, value

    def _failure(self, error: BaseException) -> tuple[str, object]:
        """Return the answer for an error: "faults" (source, faults), "driver" or "error" with the message.

        An error of another class is a fault of the law if a law was announced. Without a law, an ArithmeticError is a
        fault of the configuration, and any other error is raised again.
        """
        match error:
            case ConfigError():
                return "faults", (error.source, error.faults)
            case DriverError():
                return "driver", str(error)
            case RtloopError():
                return "error", str(error)
        if self._law is not None:
            kind, file = self._law
            return "faults", ("law", [f"law {kind!r} ({file}): raised {_error_text(error)}{_line_text(error, file)}"])
        if isinstance(error, ArithmeticError):
            return "faults", (
                "",
                [
                    f"a computation fails with the numbers of the configuration ({error}); look for a number that is "
                    "0, very small or very large"
                ],
            )
        raise error

    def _announce(self, kind: str, file: str) -> None:
        """Report the law whose code runs next, if it is another one than before."""
        if self._law != (kind, file):
            self._law = kind, file
            self._answer("begins", self._law)

    def _answer(self, kind: str, value: object) -> None:
        """Send kind and value of a message to the parent."""
        write_frame(self._answers, pickle.dumps((kind, value)))


def _load_compiler() -> None:
    """Import the compiler and compile a function in advance.

    The first compilation takes a second longer than any other.
    """
    from rtloop.foundation.native.compiler import numba

    numba.njit("float64(float64)")(_identity)


def _identity(number: float) -> float:
    """Return the number itself: compiled to load the compiler, and the job before the first preparation."""
    return number


def _line_text(error: BaseException, file: str) -> str:
    """Return ", in line N" for the line of the law's file in which the error was raised; "" if there is none."""
    lines = [number for frame, number in traceback.walk_tb(error.__traceback__) if frame.f_code.co_filename == file]
    return f", in line {lines[-1]}" if lines else ""


def _error_text(error: BaseException) -> str:
    """Return type and message of an error on one line, even if its `__str__` raises, with the hint of `_suggestion`."""
    try:
        message = " ".join(str(error).split()) + _suggestion(error)
    except BaseException:
        message = "the message of this error cannot be shown"
    return f"{type(error).__name__}: {message}" if message else type(error).__name__


def _suggestion(error: BaseException) -> str:
    """Return "; did you mean NAME?" for an AttributeError if the object has a public attribute whose name resembles or
    continues the wrong one, else "".
    """
    if not isinstance(error, AttributeError) or not error.name:
        return ""
    names = [name for name in dir(error.obj) if not name.startswith("_")]
    near = [*get_close_matches(error.name, names, 1), *(name for name in names if name.startswith(error.name))]
    return f"; did you mean {near[0]}?" if near else ""


def _streams() -> list[tuple[int, IO[str]]]:
    """Return (inode, Python object) of stdin, stdout and stderr, in this order, to tell later whether a law replaced
    one.
    """
    return [(os.fstat(number).st_ino, getattr(sys, name)) for number, name in STREAMS.items()]


def _leftover_fault(threads: int, streams: list[tuple[int, IO[str]]]) -> str | None:
    """Return the fault if the law's code left a thread or process, or replaced or closed a standard stream, else None.

    `threads` and `streams` are from before the job.
    """
    if (more := _thread._count() - threads) > 0:
        return f"left {more} thread{'s' if more > 1 else ''} running"
    try:
        if os.waitpid(-1, os.WNOHANG) == (0, 0):
            return "left a process running"
    except ChildProcessError:
        pass
    for number, (file, stream) in enumerate(streams):
        name = STREAMS[number]
        try:
            if os.fstat(number).st_ino != file or getattr(sys, name) is not stream:
                return f"replaced {name}"
            is_closed = stream.closed
        except OSError:
            is_closed = True
        if is_closed:
            return f"closed {name}"
    return None


def main() -> None:
    """Process jobs from the pipes on stdin and stdout; the law's code has access to neither."""
    jobs, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb", buffering=0)
    null_fd = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null_fd, 0)
    os.close(null_fd)
    os.dup2(2, 1)
    try:
        Worker(jobs, answers).work()
    except BrokenPipeError:  # the other process was killed meanwhile
        os._exit(1)


if __name__ == "__main__":
    main()
