"""A board in shared memory as a process of its own, for driver kind `shm`."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.benchmarks.configurations import RIG, ROOT, changed, last_cpu, write

BOARD_RATE_HZ = 10_000
STALE = ("# sample_age_us = 1000.0 ", "sample_age_us = 500000.0 ")
"""The board is a process beside others; a host that stalls it trips no interlock here."""
START_TIMEOUT_S, END_TIMEOUT_S = 120.0, 20.0
POLL_S = 0.2


def on_a_board(file: Path, *changes: tuple[str, str]) -> str:
    """The paper's configuration on the board at `file`."""
    rig = RIG.replace('kind = "sim"', f'kind = "shm"\nfile = "{file}"\nboard_rate_hz = {BOARD_RATE_HZ}')
    return changed((RIG, rig), STALE, *changes)


@contextmanager
def board() -> Iterator[Path]:
    """The file of a running board."""
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "board"
        with served(("hil", "serve", write(Path(name), on_a_board(file)))):
            yield file


@contextmanager
def served(arguments: Sequence[str | Path]) -> Iterator[None]:
    """A process of `rtloop` that has told systemd's socket, here ours, that it is ready; SIGTERM ends it.

    It runs on the processors that are not the loop's. Raises RuntimeError where it does not become ready.
    """
    command = [sys.executable, "-m", "rtloop", *map(str, arguments)]
    with tempfile.TemporaryDirectory() as name, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notified:
        notified.bind(f"{name}/notify")
        notified.settimeout(POLL_S)
        environment = os.environ | {"NOTIFY_SOCKET": f"{name}/notify"}
        process = subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True)
        try:
            os.sched_setaffinity(process.pid, os.sched_getaffinity(0) - {last_cpu()} or os.sched_getaffinity(0))
            _await_ready(process, notified)
            yield
        finally:
            process.terminate()
            try:
                process.communicate(timeout=END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()


def _await_ready(process: subprocess.Popen[str], notified: socket.socket) -> None:
    deadline_s = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline_s:
        with suppress(TimeoutError):
            if b"READY=1" in notified.recv(4096):
                return
        if process.poll() is not None:
            break
    process.kill()
    raise RuntimeError(f"{' '.join(map(str, process.args))}: {process.communicate()[1].strip() or 'not ready in time'}")
