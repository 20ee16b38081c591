"""One cell of the table: a command in its surroundings, and what is wrong with how it ended."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from tests.surroundings.commands import PROGRAM, Command, write_node_configurations
from tests.surroundings.surroundings import Surrounding

LIMIT_S = 900.0
POLL_S = 0.1
CLEAN = Surrounding()
LISTENING = "0A"
"""State of a listening socket in /proc/net/tcp; a panel has an address of its own in 127.0.0.0/8."""


@dataclass(frozen=True)
class Ending:
    """How a command ended: exit code, texts, and the bytes of its files by their path without digits of a time."""

    code: int | str
    stdout: str
    stderr: str
    files: dict[str, bytes]
    markers: list[str]


@dataclass(frozen=True)
class Bench:
    """Where cells run: the stock of files, the clean environment, and the socket of the service of shared commands."""

    folder: Path
    stock: Path
    environment: dict[str, str]
    socket: Path

    def run(self, number: int, command: Command, surrounding: Surrounding) -> Ending:
        """Run a command in a new folder; `number` tells cells that run at the same time apart."""
        place, markers, logs = (self.folder / f"{part}{number}" for part in "cml")
        for folder in (place, markers, logs):
            folder.mkdir()
        port = 20_000 + number % 20_000
        if "{place}" in command.words:
            write_node_configurations(logs, self.stock, port)
        surrounding.prepare(place, markers)
        values = {"stock": self.stock, "place": place, "port": port, "socket": self.socket}
        words = [
            word.format(**values | ({"place": logs} if "{place}" in word else {})) for word in command.words.split()
        ]
        environment = self.environment | {"RUNTIME_DIRECTORY": str(logs / "run"), "EPICS_CA_SERVER_PORT": str(port)}
        for name, value in surrounding.environment.items():
            environment.pop(name, None)
            if value is not None:
                environment[name] = value.format(place=place)
        program = [sys.executable, *surrounding.program[1:]] if surrounding.program else [str(PROGRAM)]
        before = set(_files(place))
        with open(logs / "out", "wb") as out, open(logs / "err", "wb") as err, _notifications(logs) as (address, ready):
            process = subprocess.Popen(
                ["bash", "-c", surrounding.shell, "bash", *program, *words], cwd=place, stdin=subprocess.PIPE,
                stdout=out, stderr=err, start_new_session=True, env=environment | {"NOTIFY_SOCKET": address},
            )  # fmt: skip
            code = _wait(process, command, port, ready)
        texts = [(logs / name).read_text(errors="replace") for name in ("out", "err")]
        texts = [re.sub(r"[\d.]+ s, [\d.]+ recordings/s", "TIME", text) for text in texts]
        texts = [text.replace(str(place), "PLACE").replace(str(logs), "LOGS") for text in texts]
        upwards = re.compile(rb"(\.\./)+")  # a path to the stock, longer from a folder further down
        files = {
            _name(path, place): upwards.sub(b"../", path.read_bytes()) for path in _files(place) if path not in before
        }
        return Ending(code, *texts, files, sorted(path.name for path in markers.iterdir()))


def _files(place: Path) -> Iterator[Path]:
    for folder, _, names in os.walk(os.fsencode(place)):
        for name in names:
            path = Path(os.fsdecode(os.path.join(folder, name)))
            if path.is_file():
                yield path


def _name(path: Path, place: Path) -> str:
    """Return the path below `place`, without a time; folders that a surrounding made are left out."""
    text = re.sub(r"\d{8}T\d{6}", "TIME", str(path.relative_to(place)))
    return re.sub(r"^((0{150}\d*|a\n b|a\nb|a\udcff|a 'b \[red\]|gone)/)+", "", text)


@contextmanager
def _notifications(folder: Path) -> Iterator[tuple[str, socket.socket]]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ready:
        ready.bind("")
        ready.setblocking(False)
        yield f"@{ready.getsockname()[1:].decode()}", ready


def _wait(process: subprocess.Popen[bytes], command: Command, port: int, ready: socket.socket) -> int | str:
    """Wait until the command ends, or until the service is ready, which SIGINT then ends. Returns the exit code."""
    end_s = time.monotonic() + LIMIT_S
    assert process.stdin is not None
    try:
        while command.ready and process.poll() is None and not _is_ready(command, port, ready):
            if time.monotonic() > end_s:
                return "never ready"
            time.sleep(POLL_S)
        if command.ready and process.poll() is None:
            process.send_signal(signal.SIGINT)
        return process.wait(max(1.0, end_s - time.monotonic()))
    except subprocess.TimeoutExpired:
        return "no end"
    finally:
        process.stdin.close()
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _is_ready(command: Command, port: int, ready: socket.socket) -> bool:
    if command.ready == "port":
        rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        return any(row[3] == LISTENING and int(row[1].partition(":")[2], 16) == port for row in rows)
    try:
        return b"READY=1" in ready.recv(4096)
    except BlockingIOError:
        return False


def faults(ending: Ending, clean: tuple[Ending, Ending], surrounding: Surrounding) -> list[str]:
    """Return what is wrong with an ending beside two clean ones: nothing is wrong with an empty list."""
    found = []
    messages = ending.stdout + ending.stderr
    for sign in ("Traceback", "Exception ignored", "Fatal Python error"):
        if sign in messages:
            found.append(sign)
    if ending.markers:
        found.append(f"planted code ran: {' '.join(ending.markers)}")
    if isinstance(ending.code, str) or ending.code < 0 or ending.code >= 128 or ending.code == 120:
        found.append(f"ended with {ending.code}")
    cause = surrounding.cause
    is_explained = cause is not None and (cause == "^$" or bool(re.search(cause, ending.stderr)))
    if ending.code != clean[0].code and not is_explained:
        found.append(f"exit code {ending.code}, clean {clean[0].code}")
    if ending.code != clean[0].code or (is_explained and cause != "^$"):
        return found
    for name, data in clean[0].files.items():
        if name not in ending.files:
            found.append(f"{name} is missing")
        elif clean[1].files.get(name) == data != ending.files[name] and not surrounding.other_digits:
            found.append(f"{name} differs")
        elif data and not ending.files[name]:
            found.append(f"{name} is empty")
    found += [f"{name} is new" for name in ending.files.keys() - clean[0].files.keys() if not _is_cache(name)]
    if surrounding.same_text and clean[0].stdout == clean[1].stdout != ending.stdout:
        found.append("stdout differs")
    return found


def _is_cache(name: str) -> bool:
    return name.startswith((".cache", ".config", "home", "tmp", "relative", "run/", "none/"))
