"""A panel in a separate process beside a loop at a terminal; it ends with the loop."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path

from rtloop.foundation.children import child_environment, python_command

EXIT_TIMEOUT_S = 2.0


@contextlib.contextmanager
def run_panel_process(socket: Path, port: int) -> Iterator[None]:
    """Run a panel of the service at `socket` during the block; service and panel may still be starting in the block.

    The panel has a separate process group, so that Ctrl-C reaches the loop alone. It ends when its stdin closes: after
    the block, and if this process is killed. A panel that has not ended EXIT_TIMEOUT_S after the block is killed.
    """
    command = python_command("rtloop", "panel", socket, "--port", port, "--until-stdin-ends")
    process = subprocess.Popen(command, stdin=subprocess.PIPE, process_group=0, env=child_environment())
    try:
        yield
    finally:
        try:
            process.communicate(timeout=EXIT_TIMEOUT_S)  # Closes its stdin.
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
