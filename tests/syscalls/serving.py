"""A service in a forked process, the board that outlives it, and the problems of the recordings that it leaves."""

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
from tests.syscalls.forked import fork_children
from tests.syscalls.recordings import ticks_on_disk


@cache
def board() -> Bench:
    """Return the board that serves all tries, until `end_board` or the end of this process."""
    bench, owner = Bench(Path(mkdtemp(prefix="rtloop-syscalls-"))), os.getpid()
    bench.start_board()
    atexit.register(lambda: bench.__exit__() if os.getpid() == owner else None)
    return bench


def end_board() -> None:
    """End the board of the tries if it runs, for it takes a seventh of a processor; `board` then starts another."""
    if board.cache_info().currsize:
        board().__exit__()
        board.cache_clear()


def serve(
    config: Path,
    log: Path,
    at_start: Callable[[], object] = lambda: None,
    at_ready: Callable[[], object] = lambda: None,
    at_stop: Callable[[], object] = lambda: None,
) -> None:
    """Be the service of a configuration in this process. Raises RtloopError for an exit code other than 0."""
    os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600), 2)
    sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
    warnings.simplefilter("default")  # pytest would turn the warning of an unclosed file into an error
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])
    fork_children()
    send, end = Notifier.send, Service.end

    def send_and_call(notifier: Notifier, **fields: str | int) -> None:
        send(notifier, **fields)
        if "READY" in fields:
            at_ready()

    def call_and_end(service: Service) -> None:
        at_stop()
        end(service)

    Notifier.send, Service.end = send_and_call, call_and_end  # type: ignore[method-assign]
    at_start()
    if code := daemon.serve(config):
        raise RtloopError(f"the service ended with {code}")


def run_problems(folder: Path) -> list[str]:
    """Return the problems of the recordings in `folder`: ticks in unfinished files, false counts, failed replays."""
    problems = [f"{part.name}: unfinished, with ticks" for part in folder.glob("*.part") if ticks_on_disk([part])]
    for paths in runs_in(folder):
        summary, recording = summarise(paths), rtloop.load(paths)
        if summary.complete and (summary.ticks_lost or summary.ticks_logged != len(ticks_on_disk(paths))):
            problems.append(f"{paths[0].name}: complete, with {summary.ticks_logged} ticks, {summary.ticks_lost} lost")
        if len(recording):
            verdict, rate_hz = replay(recording), recording.header["rate_hz"]
            problems += [f"{paths[0].name}: {problem}" for problem in unexplained(verdict, rate_hz)]
    return problems


def terminate() -> None:
    """Send SIGTERM to this process."""
    os.kill(os.getpid(), signal.SIGTERM)
