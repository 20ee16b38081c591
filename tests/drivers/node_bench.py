"""A simulated node in a separate process, whose outputs a test reads from shared memory."""

from __future__ import annotations

import json
import mmap
import secrets
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from rtloop.drivers.base import Wiring
from rtloop.drivers.node.driver import NodeDriver, SerialDriver, UdpDriver
from rtloop.drivers.node.options import NodeOptions, SerialOptions, UdpOptions
from tests.drivers.processes import ENVIRONMENT

ONE_AXIS = {"x": Wiring("adc0", "dac0")}
WITNESS = struct.Struct("<qqqqdd")
"""Steps, samples, parkings by the watchdog, refused frames, output in V, largest change of the output in 1 ms in V."""
PROGRAM = """
import json, mmap, sys, time
from tests.drivers.node_bench import WITNESS, make_options
from rtloop.drivers.node.keys import read_key
from rtloop.drivers.node.serving import open_port, step
from rtloop.drivers.node.simulated import SimulatedNode

options = make_options(sys.argv[1], json.loads(sys.argv[2]))
with open(sys.argv[3], "r+b") as file:
    witness = mmap.mmap(file.fileno(), WITNESS.size)
node = SimulatedNode(options, ["x"], key=read_key(options.key))
steps, window_s, first_v, largest_v, start_s = 0, 0.0, 0.0, 0.0, time.monotonic()
with open_port(options) as port:
    while True:
        step(node, port, start_s)
        steps += 1
        output_v = node.outputs_v[0]
        if time.monotonic() - window_s >= 0.001:
            window_s, first_v = time.monotonic(), output_v
        largest_v = max(largest_v, abs(output_v - first_v))
        WITNESS.pack_into(witness, 0, steps, node.samples, node.watchdog_parkings, node.refused, output_v, largest_v)
"""


def make_options(kind: str, values: dict[str, Any]) -> NodeOptions:
    """Return the options of a driver of kind "udp" or "serial"."""
    return (UdpOptions if kind == "udp" else SerialOptions).model_validate(values)


def make_key(folder: Path, name: str = "node.key") -> str:
    """Write a new key to a file that its owner alone may read; return the file's path."""
    path = folder / name
    path.touch(0o600)
    path.write_text(secrets.token_hex(16) + "\n")
    return str(path)


def free_udp_port() -> int:
    """Return a free UDP port of this computer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class NodeProcess:
    """A simulated node's process on a free UDP port or a new pseudo-terminal, with a record of its work."""

    def __init__(self, kind: str, folder: Path, **options: Any) -> None:
        place = {"host": "127.0.0.1", "port": free_udp_port()} if kind == "udp" else {"device": str(folder / "tty")}
        self.kind, self._folder = kind, folder
        self.options: dict[str, Any] = place | options
        self.start()

    def start(self) -> None:
        """Start the process, also once more after `end`."""
        path = self._folder / "witness"
        path.write_bytes(bytes(WITNESS.size))
        with path.open("r+b") as file:
            self._witness = mmap.mmap(file.fileno(), WITNESS.size)
        command = [sys.executable, "-c", PROGRAM, self.kind, json.dumps(self.options), str(path)]
        self.process = subprocess.Popen(command, env=ENVIRONMENT)

    def driver(self, rate_hz: float = 100.0, **more: Any) -> NodeDriver:
        """Return a driver of this node, not yet open; a busy host answers at the rate, too."""
        options = make_options(self.kind, self.options | {"wait_s": 60.0} | more)
        return (UdpDriver if self.kind == "udp" else SerialDriver)(options, ONE_AXIS, rate_hz)

    @property
    def steps(self) -> int:
        """Number of calls of the node's `step`."""
        return WITNESS.unpack_from(self._witness)[0]

    @property
    def samples(self) -> int:
        """Number of samples that the node has sent."""
        return WITNESS.unpack_from(self._witness)[1]

    @property
    def parkings(self) -> int:
        """Number of parkings by the watchdog."""
        return WITNESS.unpack_from(self._witness)[2]

    @property
    def refused_frames(self) -> int:
        """Number of frames that the node has refused."""
        return WITNESS.unpack_from(self._witness)[3]

    @property
    def output_v(self) -> float:
        """Present output in V."""
        return WITNESS.unpack_from(self._witness)[4]

    def settled_output_v(self) -> float:
        """Return the output in V after three further steps of the node, which process all earlier frames."""
        steps = self.steps
        while self.steps < steps + 3:
            time.sleep(0.001)
        return self.output_v

    def end(self) -> None:
        """Kill the process and wait for its end."""
        self.process.kill()
        self.process.wait()
