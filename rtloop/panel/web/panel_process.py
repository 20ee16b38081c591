"""A panel in a separate process beside a loop at a terminal; it ends with the loop."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

EXIT_TIMEOUT_S = 2.0


@contextlib.contextmanager
def run_panel_process(socket: Path, port: int) -> Iterator[None]:
    """Run a panel of the service at `socket` during the block, without waiting for service or panel.

    The panel has a separate process group, so that Ctrl-C reaches the loop alone, and it ends with its stdin, also if
    this process is killed. After the block, a panel that has not ended within EXIT_TIMEOUT_S is killed.
    """
    command = [sys.executable, "-m", "rtloop", "panel", str(socket), "--port", str(port), "--until-stdin-ends"]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, process_group=0)
    try:
        yield
    finally:
        try:
            process.communicate(timeout=EXIT_TIMEOUT_S)  # Closes its stdin.
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
