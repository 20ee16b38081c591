"""A service and `rtloop epics` beside it on free ports; caproto's client reads and writes the channels."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

from caproto import AlarmSeverity, AlarmStatus, CaprotoTimeoutError, bcast_socket
from caproto.sync import client

from tests.faults.bench import Bench
from tests.faults.configuration import ROOT
from tests.faults.evidence import wait_for
from tests.stage_text import one_axis, resonance, simulated_stage

HOST, TIMEOUT_S = "127.0.0.1", 120.0
SEARCH_S, SEARCHES = 2.0, 4
"""Duration and number of a client's searches for a channel from one port."""
OMEGA_RAD_S, DAMPING = 628.32, 0.3
UM_PER_V = 4.3
"""Gain of the simulated actuator, which has no hysteresis."""
CONFIGURATION = f"""
[loop]
rate_hz = 1000
{simulated_stage(OMEGA_RAD_S, DAMPING, UM_PER_V)}
{one_axis(um_per_v=UM_PER_V)}
[axis.controller]
form = "transfer_function"
numerator = [60.0]
denominator = [1.0, 0.0]
method = "tustin"
[axis.model]
{resonance(OMEGA_RAD_S, DAMPING)}
[axis.interlocks]
position_um = 60.0
[service]
arm = true
[recording]
folder = "FOLDER/recordings"
min_free_mib = 0.0
"""
"""A resonance at 100 Hz and a slow integrator: little computation, and settled after a quarter of a second."""


class ChannelValue(NamedTuple):
    """Value of a channel, a number or a text, and the names of its alarm's severity and status."""

    value: Any
    severity: str
    status: str


search_from_port = client.search


def search(channel: str, _socket: socket.socket, timeout_s: float) -> Any:
    """Search for a channel, each SEARCH_S from another port, until a server answers; return its address.

    The system may give a socket of caproto the port of another one, which then gets the answers.
    """
    deadline_s = time.monotonic() + timeout_s
    while True:
        with bcast_socket() as udp_socket:
            try:
                return search_from_port(channel, udp_socket, SEARCH_S, max_retries=SEARCHES)
            except CaprotoTimeoutError:
                if time.monotonic() > deadline_s:
                    raise


client.search = search


def free_port() -> int:
    """Return the number of a port that is free for TCP and for UDP."""
    while True:
        with socket.socket() as stream, socket.socket(type=socket.SOCK_DGRAM) as datagrams:
            stream.bind((HOST, 0))
            port = stream.getsockname()[1]
            try:
                datagrams.bind((HOST, port))
            except OSError:
                continue
            return port


def make_bench(folder: Path) -> Bench:
    """Return the bench of a service with CONFIGURATION; its loop drives once a client has armed and started it."""
    return Bench(folder, board=False, text=CONFIGURATION.replace("FOLDER", str(folder)))


class Adapter:
    """`with Adapter(bench, "L:") as adapter`: a process `rtloop epics`, and a client that finds no other server."""

    def __init__(self, bench: Bench, prefix: str, *options: str) -> None:
        self.bench = bench
        self.prefix, self.port, self.log_file = prefix, free_port(), bench.folder / f"epics-{prefix[0]}.log"
        self._command = [
            *(sys.executable, "-m", "rtloop", "epics", "--socket", str(bench.client.path), "--prefix", prefix, *options)
        ]
        self.environment = {
            "EPICS_CA_SERVER_PORT": str(self.port),
            "EPICS_CA_ADDR_LIST": HOST,
            "EPICS_CA_AUTO_ADDR_LIST": "NO",
        }

    def __enter__(self) -> Adapter:
        environment = os.environ | self.environment | {"PYTHONPATH": str(ROOT)}
        with open(self.log_file, "w") as log:
            self.process = subprocess.Popen(self._command, env=environment, stdout=log, stderr=log)
        wait_for(lambda: "serving" in self.log() or self.process.poll() is not None, "a server", TIMEOUT_S, 0.05)
        assert self.process.poll() is None, self.log()
        return self

    def __exit__(self, *_: object) -> None:
        assert self.end() == 0
        assert "Traceback" not in self.log()

    def end(self) -> int:
        """End the process with SIGTERM; return its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        return self.process.wait(TIMEOUT_S)

    def log(self) -> str:
        """Return the output of the process so far."""
        return self.log_file.read_text()

    def get(self, suffix: str, **options: Any) -> Any:
        """Return caproto's response to a read with time and alarm; `options` go to its client."""
        return self._call(client.read, suffix, **{"data_type": "time"} | options)

    def read(self, suffix: str) -> ChannelValue:
        """Return the value and the alarm of a channel."""
        response = self.get(suffix)
        value = bytes(response.data).decode() if response.data_type.name.endswith("CHAR") else response.data[0]
        alarm = response.metadata
        severity = AlarmSeverity(alarm.severity).name.removesuffix("_ALARM")
        return ChannelValue(value, severity, AlarmStatus(alarm.status).name)

    def write(self, suffix: str, value: Any, **options: Any) -> None:
        """Write a channel and wait until the write is done; raises ErrorResponseReceived if it is refused."""
        self._call(client.write, suffix, value, **{"notify": True} | options)

    def _call(self, function: Any, suffix: str, *arguments: Any, **options: Any) -> Any:
        """Call a function of caproto's client for a channel while the environment names this server alone."""
        saved = dict(os.environ)
        os.environ.update(self.environment)
        try:
            return function(self.prefix + suffix, *arguments, timeout=TIMEOUT_S, repeater=False, **options)
        finally:
            os.environ.clear()
            os.environ.update(saved)

    def await_alarm(self, suffix: str, severity: str, status: str) -> Any:
        """Wait until a channel has this alarm; return its value then."""
        has_alarm = lambda reading: reading[1:] == (severity, status)
        return wait_for(
            lambda: [reading.value] if has_alarm(reading := self.read(suffix)) else None,
            f"{suffix} {severity}", TIMEOUT_S, 0.05,
        )[0]  # fmt: skip

    def await_text(self, suffix: str, text: str) -> None:
        """Wait until a channel shows a text that contains `text`."""
        wait_for(lambda: text in self.read(suffix).value, f"{suffix} {text!r}", TIMEOUT_S, 0.05)
