"""A loop, a simulated board and the panel, without any file of the user: three processes that end together.

    rtloop demo ──┬── board: `rtloop hil serve`, in a separate process group, which Ctrl-C does not reach
                  ├── panel: `rtloop panel`
                  └── the service, in this process, with loop and recorder as its children

The service parks on the board before the board ends. Both other processes end when their stdin closes, also if this
process is killed. Configuration and recordings lie in a temporary folder, the board's memory in another.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from rtloop.errors import UnavailableError, output_errors
from rtloop.foundation.children import child_environment, python_command
from rtloop.starters.examples import read_example
from rtloop.starters.first_start import FIRST_START, is_first_start
from rtloop.starters.new_files import write_new_files

MEMORY_FOLDER = Path("/dev/shm")
NAME, PREFIX = "demo", "rtloop-demo-"
EXIT_TIMEOUT_S, POLL_S = 5.0, 0.2


def demonstrate(port: int, announce: Callable[[str], None]) -> int:
    """Run board, service and panel until SIGINT or SIGTERM, then remove all their files. Returns the exit code.

    `port` is the panel's, 0 for any free one; `announce` receives each line for the user. Signal handlers of the
    process are replaced. Raises RtloopError and DriverError as the service does.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        from rtloop.configuration.file import load
        from rtloop.panel.web.panel_process import run_panel_process
        from rtloop.service.daemon import serve
        from rtloop.supervision.paths import block_path, hardware_path, socket_path

        if is_first_start():
            announce(FIRST_START)
        with _configuration_file() as config, _board_process(config):
            announce(
                "this is a simulated stage: arm and start its loop on the panel; Ctrl-C parks the outputs and ends all"
            )
            with run_panel_process(socket_path(load(config)), port):
                code = serve(config)
            for path in (block_path(NAME), hardware_path(NAME)):  # for `rtloop park`; the outputs are parked
                path.unlink(missing_ok=True)
            return code
    except KeyboardInterrupt:  # before the service watches for signals
        return 0


def demonstration_text(memory: Path, recordings: Path) -> str:
    """Return the configuration: the example board.toml with the board's file `memory`, the folder `recordings` and
    outputs that wait to be armed.
    """
    text = read_example("board.toml").replace('"/dev/shm/rtloop-board"', f'"{memory}"')
    return text.replace('"recordings"', f'"{recordings}"').replace("[service]\n", "[service]\narm = true\n")


@contextlib.contextmanager
def _configuration_file() -> Iterator[Path]:
    """Yield the path of the configuration, in a temporary folder that is removed with the recordings in it.

    Raises OutputError if the system refuses.
    """
    memory_parent = MEMORY_FOLDER if os.access(MEMORY_FOLDER, os.W_OK) else None
    with contextlib.ExitStack() as folders:
        with output_errors(tempfile.gettempdir()):
            parents = (None, memory_parent)
            folder, memory = (
                Path(folders.enter_context(tempfile.TemporaryDirectory(prefix=PREFIX, dir=parent)))
                for parent in parents
            )
        (config,) = write_new_files(
            folder, {f"{NAME}.toml": demonstration_text(memory / "board", folder / "recordings")}
        )
        yield config


@contextlib.contextmanager
def _board_process(config: Path) -> Iterator[None]:
    """Run the board of a configuration during the block, from its first sample on; a closed stdin ends the board.

    Raises UnavailableError if it does not start.
    """
    command = python_command("rtloop", "hil", "serve", config, "--until-stdin-ends")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notifications:
        # Linux chooses a name outside the file system, whose paths may be too long for a socket.
        notifications.bind("")
        notifications.settimeout(POLL_S)
        environment = child_environment({"NOTIFY_SOCKET": f"@{notifications.getsockname()[1:].decode()}"})
        process = subprocess.Popen(command, stdin=subprocess.PIPE, process_group=0, env=environment)
        try:
            _wait_until_ready(notifications, process)
            yield
        finally:
            try:
                process.communicate(timeout=EXIT_TIMEOUT_S)  # closes its stdin
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()


def _wait_until_ready(notifications: socket.socket, process: subprocess.Popen[bytes]) -> None:
    """Wait for the first message on `notifications`. Raises UnavailableError if the process ends before a message."""
    while process.poll() is None:
        with contextlib.suppress(TimeoutError):
            notifications.recv(64)
            return
    raise UnavailableError(f"the simulated board ended with exit code {process.returncode}; its message is above")
