"""The program rtloop-node as a process, and clients of it over UDP and over a serial line."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import struct
import subprocess
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from tests.node.frames import UNSEALED, Refusal, Sample, Seal, Welcome, cobs, parse, uncobs

LONGEST_S = 10.0
"""Time-out in s of an answer on a busy machine."""
Exchange = Callable[..., Welcome | Sample | Refusal | None]
NO_KEY = "no key: whoever reaches the node may drive it; --key FILE keeps others off\n"


class Output(NamedTuple):
    """An output in the witness file: code, largest change of a step, largest change in 1 ms."""

    code: int
    change: int
    change_per_ms: int


class Witness(NamedTuple):
    """Content of the program's witness file."""

    digital: int
    writes: int
    watchdog_trips: int
    outputs: list[Output]


def read_witness(path: Path) -> Witness:
    """Return a consistent copy of the witness file."""
    while True:
        content = path.read_bytes()
        magic, sequence, outputs, digital, writes, trips = struct.unpack_from("=IIIIQQ", content)
        assert magic == 0x57544E52
        if sequence % 2 == 0 and path.read_bytes()[4:8] == content[4:8]:
            fields = [struct.unpack_from("=iIII", content, 32 + 16 * i)[:3] for i in range(outputs)]
            return Witness(digital, writes, trips, [Output(*output) for output in fields])


class NodeProcess:
    """A process of rtloop-node, with the port and the boot number that it prints."""

    def __init__(self, programs: Path, *options: str | Path):
        command = [programs / "rtloop-node", *map(str, options)]
        self._notice = "" if "--key" in options else NO_KEY
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        start = self.process.stdout.readline()
        assert start, self.process.communicate()[1]
        fields = json.loads(start)
        self.port: int = fields["port"]
        self.boot: int = fields["boot"]

    def stop(self, number: int = signal.SIGTERM) -> dict[str, int]:
        """Stop the program by a signal and return its counters; after SIGKILL, an empty dict."""
        self.process.send_signal(number)
        output, errors = self.process.communicate(timeout=LONGEST_S)
        if number == signal.SIGKILL:
            return {}
        assert (self.process.returncode, errors) == (0, self._notice)
        return json.loads(output)


@contextmanager
def running(programs: Path, *options: str | Path) -> Iterator[NodeProcess]:
    """Yield a node's process, and kill it at the end if it still runs."""
    node = NodeProcess(programs, *options)
    try:
        yield node
    finally:
        node.process.kill()
        node.process.communicate()


@contextmanager
def udp_client(port: int, host: str = "127.0.0.1") -> Iterator[Exchange]:
    """Yield a function that sends a frame over UDP and returns the fields of the answer, judged by a seal."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as client:
        client.settimeout(LONGEST_S)
        client.connect((host, port))

        def exchange(frame: bytes, seal: Seal = UNSEALED) -> Welcome | Sample | Refusal | None:
            client.send(frame)
            return parse(client.recv(2048), seal)

        yield exchange


@contextmanager
def serial_line(device: Path) -> Iterator[Callable[[bytes, int], list[bytes]]]:
    """Yield a function that writes bytes to a serial device and returns a number of answered frames."""
    file = os.open(device, os.O_RDWR | os.O_NOCTTY)
    tty.setraw(file, termios.TCSANOW)

    def exchange(content: bytes, frames: int) -> list[bytes]:
        os.write(file, content)
        line, end_s = b"", time.monotonic() + LONGEST_S
        while line.count(0) < frames and time.monotonic() < end_s:
            if select.select([file], [], [], LONGEST_S)[0]:
                line += os.read(file, 4096)
        return [uncobs(coded) for coded in line.split(b"\0")[:-1]]

    try:
        yield exchange
    finally:
        os.close(file)


@contextmanager
def serial_client(device: Path) -> Iterator[Exchange]:
    """Yield a function that sends a frame over a serial device and returns the fields of the answer."""
    with serial_line(device) as exchange:
        yield lambda frame: parse(exchange(cobs(frame), 1)[0])


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds. Raises AssertionError after LONGEST_S."""
    end_s = time.monotonic() + LONGEST_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.002)
