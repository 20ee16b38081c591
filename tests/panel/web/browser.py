"""A browser by hand: requests to a panel with exact headers, a session, unpacked messages."""

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
from tests.panel.served import Answer, exchange

TIMEOUT_S = 30.0


def unpacked(message: Any) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a binary message, by the words of its description alone."""
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
    """Talks to the panel of a bench; `process` is the panel's."""

    def __init__(self, bench: Bench, *options: str) -> None:
        (bench.folder / "log").touch()
        mark = len(bench.log())
        self.process: subprocess.Popen[str] = bench.rtloop("panel", bench.client.path, "--port", "0", *options)
        said = wait_for(
            lambda: re.search(r"http://127\.0\.0\.1:(\d+)/#token=(\S+)", bench.log()[mark:]), "a panel", 120
        )
        self.port, self.token = int(said[1]), said[2]
        self.origin = f"http://127.0.0.1:{self.port}"
        self.cookie = ""

    def request(self, method: str, path: str, body: Any = None, headers: dict[str, Any] | None = None) -> Answer:
        """Send a request as a page does, with other `headers`; None leaves one out."""
        return exchange(self.port, method, path, body, {"Origin": self.origin, "Cookie": self.cookie} | (headers or {}))

    def json(self, method: str, path: str, body: Any = None) -> tuple[int, Any]:
        """Status and JSON of an answer."""
        status, _, data = self.request(method, path, body)
        return status, json.loads(data) if data else None

    def log_in(self) -> Browser:
        """Exchange the token for a session; returns this browser."""
        status, headers, _ = self.request("POST", "/session", {"token": self.token})
        assert status == 204
        self.cookie = headers["set-cookie"].split(";")[0]
        return self

    @contextmanager
    def live(self, *wishes: dict[str, Any], headers: dict[str, str] | None = None) -> Iterator[ClientConnection]:
        """The stream, with wishes."""
        mine = {"Origin": self.origin, "Cookie": self.cookie} | (headers or {})
        address = f"ws://127.0.0.1:{self.port}/live"
        limits: dict[str, Any] = {
            "compression": None,
            "max_size": None,
            "open_timeout": TIMEOUT_S,
            "close_timeout": 1.0,
        }
        with connect(address, additional_headers=mine, **limits) as live:
            for wish in wishes:
                live.send(json.dumps(wish))
            yield live

    def first(self, live: ClientConnection, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """The next message of a kind."""
        for message in live:
            header, arrays = unpacked(message)
            if header["kind"] == kind:
                return header, arrays
        raise AssertionError(f"no {kind} any more")
