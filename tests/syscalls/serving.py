"""A service in a forked process, on a board that outlives it, and what is wrong with the recordings that it leaves."""

from __future__ import annotations

import atexit
import os
import signal
import sys
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import rtloop
from rtloop.errors import RtloopError
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.summary import summarise
from rtloop.service import daemon
from rtloop.service.notify import Notifier
from rtloop.service.service import Service
from tests.faults.account import runs_in, unexplained
from tests.faults.bench import Bench
from tests.syscalls.forked import without_imports
from tests.syscalls.recordings import ticks_on_disk


@cache
def board() -> Bench:
    """A board that serves all tries, and ends with this process."""
    bench, owner = Bench(Path(mkdtemp(prefix="rtloop-syscalls-"))), os.getpid()
    bench.start_board()
    atexit.register(lambda: bench.__exit__() if os.getpid() == owner else None)
    return bench


def serve(
    config: Path,
    log: Path,
    at_start: Callable[[], object] = lambda: None,
    at_ready: Callable[[], object] = lambda: None,
    at_stop: Callable[[], object] = lambda: None,
) -> None:
    """Be the service of a configuration in this process. Raises RtloopError, with the exit code where it is not 0."""
    os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600), 2)
    sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
    warnings.simplefilter("default")  # under pytest a file that nobody closed would be said as an error
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])
    without_imports()
    send, end = Notifier.send, Service.end

    def sent(notifier: Notifier, **fields: str | int) -> None:
        send(notifier, **fields)
        if "READY" in fields:
            at_ready()

    def told_to_end(service: Service) -> None:
        at_stop()
        end(service)

    Notifier.send, Service.end = sent, told_to_end  # type: ignore[method-assign]
    at_start()
    if code := daemon.serve(config):
        raise RtloopError(f"the service ended with {code}")


def problems_of_runs(folder: Path) -> list[str]:
    """What is wrong with the recordings that the last hand left: ticks in an unfinished file, a false verdict."""
    problems = [f"{part.name}: left behind" for part in folder.glob("*.part") if ticks_on_disk([part])]
    for paths in runs_in(folder):
        summary, recording = summarise(paths), rtloop.load(paths)
        if summary.complete and (summary.ticks_lost or summary.ticks_logged != len(ticks_on_disk(paths))):
            problems.append(f"{paths[0].name}: complete, with {summary.ticks_logged} ticks, {summary.ticks_lost} lost")
        if len(recording):
            verdict = replay(recording)
            problems += [f"{paths[0].name}: {one}" for one in unexplained(verdict, recording.header["rate_hz"])]
    return problems


def terminate() -> None:
    """Tell this process to end."""
    os.kill(os.getpid(), signal.SIGTERM)
