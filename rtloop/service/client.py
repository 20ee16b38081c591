"""A client of the control API, for `rtloop ctl` and for scripts: HTTP on a UNIX socket with the standard library."""

from __future__ import annotations

import http.client
import json
import socket
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rtloop.errors import RtloopError, UnavailableError

TIMEOUT_S = 10.0


class _UnixConnection(http.client.HTTPConnection):
    def __init__(self, path: Path) -> None:
        super().__init__("localhost", timeout=TIMEOUT_S)
        self._path = path

    def connect(self) -> None:
        """To the socket's path."""
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(TIMEOUT_S)
        self.sock.connect(str(self._path))


class Client:
    """Talks to the service at `path`."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def get(self, resource: str) -> Any:
        """JSON, or text where it is none. Raises UnavailableError, RtloopError."""
        return self._request("GET", resource, None)

    def post(self, resource: str, body: Mapping[str, Any] | None = None) -> Any:
        """The answer. Raises UnavailableError, or RtloopError with what the service says against it."""
        return self._request("POST", resource, json.dumps(body or {}))

    def watch(self) -> Iterator[dict[str, Any]]:
        """Newest signals, about 20 times a second. Raises UnavailableError."""
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import unix_connect

        try:
            with unix_connect(str(self.path), "ws://localhost/watch") as connection:
                for message in connection:
                    yield json.loads(message)
        except (OSError, WebSocketException) as error:
            raise UnavailableError(f"{self.path}: {error}") from None

    def _request(self, method: str, resource: str, body: str | None) -> Any:
        connection = _UnixConnection(self.path)
        try:
            connection.request(method, resource, body, {"Content-Type": "application/json"})
            response = connection.getresponse()
            text = response.read().decode()
        except (OSError, http.client.HTTPException) as error:
            reason = getattr(error, "strerror", None) or error
            raise UnavailableError(f"{self.path}: no service answers there ({reason})") from None
        finally:
            connection.close()
        answer = json.loads(text) if "json" in (response.getheader("Content-Type") or "") else text
        if response.status >= 400:
            raise RtloopError(answer["error"] if isinstance(answer, dict) else f"{response.status} {answer}")
        return answer
