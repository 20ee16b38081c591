"""Third-party clients (schemathesis, promtool) find no fault in the description and metrics of a running service."""

from __future__ import annotations

import re
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest

from rtloop.service.api.requests import REQUESTS
from tests.faults.bench import Bench
from tests.service.http import exchange

pytestmark = pytest.mark.system

CONFIGURATION = Path(__file__).with_name("schemathesis.toml")
CASES = 5
"""Random cases of each operation, in addition to those at the bounds of its schema."""
CHUNK_BYTES = 1 << 16


@pytest.fixture
def address(running: Bench) -> Iterator[str]:
    """Yield the address of the control API on a local TCP port, for clients that cannot use UNIX sockets."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        threading.Thread(target=_accept, args=(listening, running.client.path), daemon=True).start()
        yield f"http://127.0.0.1:{listening.getsockname()[1]}"
        listening.shutdown(socket.SHUT_RDWR)


def _accept(listening: socket.socket, path: Path) -> None:
    """Connect each client to the UNIX socket at `path`, until `listening` is shut down."""
    with suppress(OSError):
        while True:
            client, _ = listening.accept()
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # without it each short body waits for 40 ms
            threading.Thread(target=_connect, args=(client, path), daemon=True).start()


def _connect(client: socket.socket, path: Path) -> None:
    """Forward between a client and the UNIX socket at `path` until both have ended."""
    with client, socket.socket(socket.AF_UNIX) as service:
        service.connect(str(path))
        responses = threading.Thread(target=_forward, args=(service, client), daemon=True)
        responses.start()
        _forward(client, service)
        responses.join()


def _forward(source: socket.socket, target: socket.socket) -> None:
    """Forward all bytes from `source` to `target`, then the end of the stream."""
    with suppress(OSError):
        while data := source.recv(CHUNK_BYTES):
            target.sendall(data)
        target.shutdown(socket.SHUT_WR)


@pytest.mark.skipif(find_spec("schemathesis") is None, reason="schemathesis is not installed: make tools")
def test_schemathesis_finds_no_fault_of_the_description(address: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "schemathesis.cli", "--config-file", str(CONFIGURATION), "run"]
    options = ["--phases", "coverage,fuzzing", "-n", str(CASES), "--seed", "1", "--no-color"]
    result = subprocess.run(
        [*command, f"{address}/openapi.json", *options], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout[-4000:] + result.stderr[-2000:]
    tested = re.search(r"Tested: (\d+)", result.stdout)
    assert tested is not None
    assert int(tested[1]) == len(REQUESTS)


@pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool is not installed: make tools")
def test_promtool_finds_no_fault_of_the_metrics(running: Bench) -> None:
    code, text = exchange(running.client.path, "GET", "/metrics")
    assert code == 200
    result = subprocess.run(["promtool", "check", "metrics"], input=text, capture_output=True, check=False)
    assert (result.returncode, result.stdout, result.stderr) == (0, b"", b"")
