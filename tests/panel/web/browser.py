"""Client of a panel that sends requests with exact headers, keeps a session, and unpacks binary messages."""

from __future__ import annotations

import json
import re
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from websockets.sync.client import ClientConnection, connect

from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.panel.route_server import Response, exchange

TIMEOUT_S = 30.0


def unpack_message(message: Any) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return header and arrays (float32) of a binary message, decoded by the description of the format alone."""
    size = struct.unpack_from("<I", message)[0]
    header = json.loads(message[4 : 4 + size])
    offset, arrays = 4 + size, {}
    assert offset % 8 == 0
    for name, length in header["arrays"]:
        arrays[name] = np.frombuffer(message, "<f4", length, offset)
        offset += 4 * length
    assert offset == len(message)
    return header, arrays


class Browser:
    """Starts a panel for the service of a bench, as `process`, and sends requests to it."""

    def __init__(self, bench: Bench, *options: str) -> None:
        (bench.folder / "log").touch()
        log_length = len(bench.log())
        self.process: subprocess.Popen[str] = bench.rtloop("panel", bench.client.path, "--port", "0", *options)
        match = wait_for(
            lambda: re.search(r"http://(127\.[\d.]+):(\d+)/#token=(\S+)", bench.log()[log_length:]), "a panel", 120
        )
        self.host, self.port, self.token = match[1], int(match[2]), match[3]
        self.origin = f"http://{self.host}:{self.port}"
        self.session = ""

    def request(self, method: str, path: str, body: Any = None, headers: dict[str, Any] | None = None) -> Response:
        """Send a request as a page does, with `headers` added or replaced; None leaves a header out."""
        all_headers = {"Origin": self.origin, "Authorization": f"Bearer {self.session}"} | (headers or {})
        return exchange(self.port, method, path, body, all_headers, self.host)

    def json(self, method: str, path: str, body: Any = None) -> tuple[int, Any]:
        """Send a request as a page does; return the status and the JSON of the response, None if it is empty."""
        status, _, data = self.request(method, path, body)
        return status, json.loads(data) if data else None

    def log_in(self) -> Browser:
        """Exchange the token for a session; return this browser."""
        response = self.request("POST", "/session", {"token": self.token}, {"Authorization": None})
        assert response.code == 200
        self.session = response.json["session"]
        return self

    @contextmanager
    def live(
        self, *subscriptions: dict[str, Any], headers: dict[str, str] | None = None, session: str | None = None
    ) -> Iterator[ClientConnection]:
        """Yield a connection to `/live`, after these subscriptions were sent; `session` replaces the own secret."""
        all_headers = {"Origin": self.origin} | (headers or {})
        address = f"ws://{self.host}:{self.port}/live"
        limits: dict[str, Any] = {
            "compression": None,
            "subprotocols": ["rtloop", f"rtloop.session.{self.session if session is None else session}"],
            "max_size": None,
            "open_timeout": TIMEOUT_S,
            "close_timeout": 1.0,
        }
        with connect(address, additional_headers=all_headers, **limits) as live:
            for subscription in subscriptions:
                live.send(json.dumps(subscription))
            yield live

    def next_message(self, live: ClientConnection, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Read up to the next message of a kind; return its header and arrays."""
        for message in live:
            header, arrays = unpack_message(message)
            if header["kind"] == kind:
                return header, arrays
        raise AssertionError(f"the connection ended without a message {kind}")
