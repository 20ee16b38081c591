"""A board in shared memory, served by a separate process, for driver kind `shm`."""

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
"""Change: a limit of the sample's age so high that a host that stalls the board's process trips no interlock."""
START_TIMEOUT_S, END_TIMEOUT_S = 120.0, 20.0
POLL_S = 0.2


def board_configuration(file: Path, *changes: tuple[str, str]) -> str:
    """Return the paper's configuration, changed to the board at `file`."""
    rig = RIG.replace('kind = "sim"', f'kind = "shm"\nfile = "{file}"\nboard_rate_hz = {BOARD_RATE_HZ}')
    return changed((RIG, rig), STALE, *changes)


@contextmanager
def board() -> Iterator[Path]:
    """Run a board in a process; yield its file."""
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "board"
        with running_rtloop(("hil", "serve", write(Path(name), board_configuration(file)))):
            yield file


@contextmanager
def running_rtloop(arguments: Sequence[str | Path]) -> Iterator[None]:
    """Run `rtloop ARGUMENTS` in a process that is ready (READY=1 on its NOTIFY_SOCKET); end it with SIGTERM.

    It runs on all processors but the loop's. Raises RuntimeError if it does not become ready.
    """
    command = [sys.executable, "-m", "rtloop", *map(str, arguments)]
    with tempfile.TemporaryDirectory() as name, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify_socket:
        notify_socket.bind(f"{name}/notify")
        notify_socket.settimeout(POLL_S)
        environment = os.environ | {"NOTIFY_SOCKET": f"{name}/notify"}
        process = subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True)
        try:
            os.sched_setaffinity(process.pid, os.sched_getaffinity(0) - {last_cpu()} or os.sched_getaffinity(0))
            _await_ready(process, notify_socket)
            yield
        finally:
            process.terminate()
            try:
                process.communicate(timeout=END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()


def _await_ready(process: subprocess.Popen[str], notify_socket: socket.socket) -> None:
    """Wait for READY=1 on the socket. Raises RuntimeError if the process ends or the time is over."""
    deadline_s = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline_s:
        with suppress(TimeoutError):
            if b"READY=1" in notify_socket.recv(4096):
                return
        if process.poll() is not None:
            break
    process.kill()
    raise RuntimeError(f"{' '.join(map(str, process.args))}: {process.communicate()[1].strip() or 'not ready in time'}")
