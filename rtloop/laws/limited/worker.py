"""The limited process: runs one function after the other, says which law's code runs, and what came of it.

A job is two messages: what to run, with all that must be imported or loaded for it, which is acknowledged; then the
arguments, with which the code of a law may begin to run. The first may come without the second, for a job that is
expected. Whatever that raises, SystemExit and KeyboardInterrupt among it, becomes an answer. Its output goes to stderr,
which the other process reads.
"""

from __future__ import annotations

import _thread
import os
import pickle
import signal
import sys
import traceback
from collections.abc import Callable
from difflib import get_close_matches
from typing import IO, Any, NamedTuple

from rtloop.drivers.errors import DriverError
from rtloop.errors import ConfigError, RtloopError
from rtloop.laws.limited.announced import listen
from rtloop.laws.limited.frames import read_frame, write_frame

SPARE_S = 5.0
"""Of processor time beyond its limit, after which the process ends: the other one may have been killed meanwhile."""
PREPARE, RUN = "prepare", "run"
"""Kinds of messages: with a `Preparation`, and with the pickled arguments."""
STREAMS = {0: "stdin", 1: "stdout", 2: "stderr"}


class Preparation(NamedTuple):
    """What comes before the arguments: where the other process is, what to run, whether the compiler is needed."""

    folder: str
    module_folders: list[str]
    function: bytes
    compiles: bool
    limit_s: float


class Worker:
    """Answers jobs until there are no more."""

    def __init__(self, jobs: IO[bytes], answers: IO[bytes]) -> None:
        self._jobs, self._answers = jobs, answers
        self._pid = os.getpid()
        self._law: tuple[str, str] | None = None
        listen(self._announce)

    def work(self) -> None:
        """Until the other process ends, or closes its pipe. Arguments are for the preparation that came last."""
        function: Callable[..., Any] = _identity
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

    def _prepare(self, preparation: Preparation) -> Callable[..., Any]:
        """The function of a job, with all that it needs loaded, which is acknowledged."""
        os.chdir(preparation.folder)
        sys.path[:] = preparation.module_folders
        function = pickle.loads(preparation.function)
        if preparation.compiles:
            _load_compiler()
        self._answer("ready", None)
        return function

    def _outcome(self, function: Callable[..., Any], arguments: bytes) -> tuple[str, Any]:
        """Kind and value of an answer; a value that was computed is pickled."""
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

    def _failure(self, error: BaseException) -> tuple[str, Any]:
        """What an error becomes; one that is none of rtloop's is the law's, where one was announced."""
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
            return "faults", ("", [f"its numbers cannot be computed with ({error})"])
        raise error

    def _announce(self, kind: str, file: str) -> None:
        if self._law != (kind, file):
            self._law = kind, file
            self._answer("begins", self._law)

    def _answer(self, kind: str, value: Any) -> None:
        write_frame(self._answers, pickle.dumps((kind, value)))


def _load_compiler() -> None:
    """Import the compiler and compile something: the first function takes a second more than any other."""
    from rtloop.hil.native.compiler import numba

    numba.njit("float64(float64)")(_identity)


def _identity(number: float) -> float:
    return number


def _line_text(error: BaseException, file: str) -> str:
    """Where in the law's own file it was raised."""
    lines = [number for frame, number in traceback.walk_tb(error.__traceback__) if frame.f_code.co_filename == file]
    return f", in line {lines[-1]}" if lines else ""


def _error_text(error: BaseException) -> str:
    """Type and message of an error on one line, whatever it raises when it is asked for them."""
    try:
        message = " ".join(str(error).split()) + _suggestion(error)
    except BaseException:
        message = "its message cannot be shown"
    return f"{type(error).__name__}: {message}" if message else type(error).__name__


def _suggestion(error: BaseException) -> str:
    """Suggest the attribute that is like a missing one."""
    if not isinstance(error, AttributeError) or not error.name:
        return ""
    names = [name for name in dir(error.obj) if not name.startswith("_")]
    near = [*get_close_matches(error.name, names, 1), *(name for name in names if name.startswith(error.name))]
    return f"; did you mean {near[0]}?" if near else ""


def _streams() -> list[tuple[int, Any]]:
    """What the standard streams are: the files behind their numbers, and Python's objects."""
    return [(os.fstat(number).st_ino, getattr(sys, name)) for number, name in STREAMS.items()]


def _leftover_fault(threads: int, streams: list[tuple[int, Any]]) -> str | None:
    """What the law's code has left behind that would disturb any process that runs it; None where it left nothing."""
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
        except OSError:
            return f"closed {name}"
        if stream.closed:
            return f"closed {name}"
    return None


def main() -> None:
    """Work with the pipes on stdin and stdout; the law's code gets neither."""
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
