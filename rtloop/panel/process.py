"""A panel beside a loop that somebody started at a terminal: a process of its own, which ends with it."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

EXIT_TIMEOUT_S = 2.0


@contextlib.contextmanager
def run_panel_process(socket: Path, port: int) -> Iterator[None]:
    """A panel of the service at `socket`, whether or not it answers yet; nothing waits for the panel.

    It has its own process group, so that Ctrl-C is for the loop, and it ends with its stdin: however we end.
    """
    command = [sys.executable, "-m", "rtloop", "panel", str(socket), "--port", str(port), "--until-stdin-ends"]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, process_group=0)
    assert process.stdin is not None
    try:
        yield
    finally:
        process.stdin.close()
        try:
            process.wait(EXIT_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
