"""Another law, built and judged in a process of its own: one that takes too long is killed, and whoever asked is told.

The process is started once the loop runs, so that it does not delay the loop, and waits; a killed one is replaced by
the next change. It reads pickled configurations on its stdin and writes pickled answers to its stdout, and ends with
its stdin: with the service.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import select
import struct
import subprocess
import sys
import threading
import time
from typing import IO, Any, Literal

from rtloop.configuration.file import Configuration
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.drivers.errors import DriverError
from rtloop.errors import ConfigError, RtloopError, UnavailableError
from rtloop.service.changing.preview import Figures, figures

BUILD_S = 10.0
"""A law that is not built and verified within this is refused."""
START_S = 120.0
_LENGTH = struct.Struct("<Q")
Job = Literal["prepare", "figures"]


class Builder:
    """Builds one configuration at a time; thread-safe."""

    def __init__(self, build_s: float = BUILD_S) -> None:
        self.build_s = build_s
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._ready = False

    @property
    def pid(self) -> int | None:
        """Of its process; None where none runs."""
        return None if self._process is None else self._process.pid

    def start(self) -> None:
        """Start its process without waiting for it; one that cannot be started is tried again by the first change."""
        with self._lock, contextlib.suppress(OSError):
            self._start()

    def _start(self) -> None:
        if self._process is not None and self._process.poll() is None:
            return
        self.end()
        self._ready = False
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rtloop.service.changing.building"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            process_group=0,
            bufsize=0,
        )

    def prepare(self, configuration: Configuration) -> Prepared:
        """As `configuration.prepare`. Raises ConfigError, DriverError, UnavailableError where it takes too long."""
        return self._done("prepare", configuration)

    def figures(self, configuration: Configuration, number: int) -> Figures:
        """As `preview.figures`, of a configuration that is prepared first. Raises as `prepare`."""
        return self._done("figures", configuration, number)

    def _done(self, job: Job, configuration: Configuration, *arguments: Any) -> Any:
        with self._lock:
            self._start()
            if not self._ready:
                self._answer(START_S)
                self._ready = True
            self._send(pickle.dumps((job, configuration, *arguments)))
            kind, value = self._answer(self.build_s)
        if kind == "done":
            return value
        if kind == "faults":
            raise ConfigError(configuration.name, value)
        raise DriverError(value) if kind == "driver" else RtloopError(value)

    def end(self) -> None:
        """Kill the process, if there is one."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    with contextlib.suppress(BrokenPipeError):
                        pipe.close()
            self._process = None

    def _send(self, data: bytes) -> None:
        assert self._process is not None
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it died: its answer does not come
            _write(self._process.stdin, data)

    def _answer(self, limit_s: float) -> tuple[str, Any]:
        """What the process says within `limit_s`; it is killed where it says nothing. Raises UnavailableError."""
        assert self._process is not None
        assert self._process.stdout is not None
        fd, deadline_s = self._process.stdout.fileno(), time.monotonic() + limit_s
        data = bytearray()
        while len(data) < _LENGTH.size or len(data) < _LENGTH.size + _LENGTH.unpack_from(data)[0]:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0 or not select.select([fd], [], [], left_s)[0]:
                self.end()
                raise UnavailableError(f"building the law took longer than {limit_s:g} s and was given up")
            part = os.read(fd, 1 << 20)
            if not part:
                self.end()
                raise UnavailableError("building the law: its process died")
            data += part
        return pickle.loads(data[_LENGTH.size :])


def _write(pipe: IO[bytes], data: bytes) -> None:
    """All of `data` behind its length, whatever a single write takes."""
    left = memoryview(_LENGTH.pack(len(data)) + data)
    while left:
        left = left[pipe.write(left) :]


_builder = Builder()


def prepare_limited(configuration: Configuration) -> Prepared:
    """Prepare a change of a service in the process beside it. Raises as `Builder.prepare`."""
    return _builder.prepare(configuration)


def figures_limited(configuration: Configuration, number: int) -> Figures:
    """What a configuration makes of axis `number`, found out in the process beside. Raises as `Builder.figures`."""
    return _builder.figures(configuration, number)


def expect_changes() -> None:
    """Have the process ready before it is needed."""
    _builder.start()


@contextlib.contextmanager
def builder_ended() -> Any:
    """In the end there is no process beside the service any more."""
    try:
        yield
    finally:
        _builder.end()


def _build(job: Job, configuration: Configuration, *arguments: Any) -> tuple[str, Any]:
    """Kind and value of an answer."""
    try:
        prepared = prepare(configuration)
        return "done", prepared if job == "prepare" else figures(prepared, *arguments)
    except ConfigError as error:
        return "faults", error.faults
    except DriverError as error:
        return "driver", str(error)
    except ArithmeticError as error:
        return "faults", [f"its numbers cannot be computed with ({error})"]


def main() -> None:
    """Answer until stdin ends."""
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # what a library prints goes where messages go
    with contextlib.suppress(BrokenPipeError):  # the service was killed meanwhile
        _write(answers, pickle.dumps(("ready", None)))
        while len(length := sys.stdin.buffer.read(_LENGTH.size)) == _LENGTH.size:
            data = sys.stdin.buffer.read(_LENGTH.unpack(length)[0])
            _write(answers, pickle.dumps(_build(*pickle.loads(data))))


if __name__ == "__main__":
    main()
