"""HTTP server for some routes of the panel, and requests with exact headers, as a hostile client sends them."""

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
"""Time-out of a request: the longest measurement on a loaded host ends before."""


class Response(NamedTuple):
    """Status, headers with names in lower case, and body of a response."""

    code: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


def exchange(
    port: int, method: str, path: str, body: Any, headers: Mapping[str, str | None], host: str = "127.0.0.1"
) -> Response:
    """Send a request with these headers and its length alone to a port of `host`; return the response.

    The header Host is added unless `headers` has it; None leaves a header out; a body that is not bytes becomes JSON.
    """
    data = body if isinstance(body, bytes | None) else json.dumps(body).encode()
    with closing(http.client.HTTPConnection(host, port, timeout=TIMEOUT_S)) as connection:
        connection.putrequest(method, path, skip_host="Host" in headers, skip_accept_encoding=True)
        for name, value in {"Content-Length": str(len(data or b"")), **headers}.items():
            if value is not None:
                connection.putheader(name, value)
        connection.endheaders(data)
        response = connection.getresponse()
        return Response(response.status, {k.lower(): v for k, v in response.getheaders()}, response.read())


class RouteServer:
    """Server of `routes` in a thread, on `port` of 127.0.0.1, until `close`; `settings` go to uvicorn."""

    def __init__(self, routes: Sequence[BaseRoute], **settings: Any) -> None:
        listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = listener.getsockname()[1]
        config = uvicorn.Config(Starlette(routes=routes), log_level="critical", lifespan="off", **settings)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([listener],), daemon=True)
        self._thread.start()
        wait_for(lambda: self._server.started, "a server")

    def request(self, path: str, method: str = "GET", body: Any = None, **headers: str) -> Response:
        """Send a request to the server with these headers alone; return the response."""
        return exchange(self.port, method, path, body, headers)

    def close(self) -> None:
        self._server.should_exit = True
        self._thread.join(30)
