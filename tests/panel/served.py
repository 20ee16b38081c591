"""Routes at a separate port for a test that sends requests as a stranger does."""

from __future__ import annotations

import http.client
import json
import socket
import threading
from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import Any, NamedTuple

import uvicorn
from starlette.applications import Starlette
from starlette.routing import BaseRoute

from tests.faults.evidence import wait_for

TIMEOUT_S = 300.0
"""For the longest measurement on a loaded host."""


class Answer(NamedTuple):
    """Status, headers with names in lower case, and body of a response."""

    code: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


def exchange(port: int, method: str, path: str, body: Any, headers: Mapping[str, str | None]) -> Answer:
    """Send a request with exactly these headers and its length; None leaves a header out; bodies become JSON."""
    data = body if isinstance(body, bytes | None) else json.dumps(body).encode()
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=TIMEOUT_S)) as connection:
        connection.putrequest(method, path, skip_host="Host" in headers, skip_accept_encoding=True)
        for name, value in {"Content-Length": str(len(data or b"")), **headers}.items():
            if value is not None:
                connection.putheader(name, value)
        connection.endheaders(data)
        response = connection.getresponse()
        return Answer(response.status, {k.lower(): v for k, v in response.getheaders()}, response.read())


class Served:
    """Routes that a thread serves until `close`; `port` on 127.0.0.1."""

    def __init__(self, routes: Sequence[BaseRoute], **settings: Any) -> None:
        listening = socket.create_server(("127.0.0.1", 0))
        self.port: int = listening.getsockname()[1]
        config = uvicorn.Config(Starlette(routes=routes), log_level="critical", lifespan="off", **settings)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([listening],), daemon=True)
        self._thread.start()
        wait_for(lambda: self._server.started, "a server")

    def ask(self, path: str, method: str = "GET", body: Any = None, **headers: str) -> Answer:
        return exchange(self.port, method, path, body, headers)

    def close(self) -> None:
        self._server.should_exit = True
        self._thread.join(30)
