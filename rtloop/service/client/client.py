"""A client of the control API: HTTP on a UNIX socket with the standard library."""

from __future__ import annotations

import http.client
import json
import socket
import struct
import threading
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rtloop.errors import HostRefusal, LoopFault, RtloopError, UnavailableError
from rtloop.foundation.trusted import UntrustedPath, trusted_owners
from rtloop.supervision.paths import host_refusal

TIMEOUT_S = 20.0
MEASUREMENT_TIMEOUT_S = 360.0
"""Longest wait for the answer to a measurement; a learning may last 300 s."""
_TIMEVAL, _CREDENTIALS = struct.Struct("@ll"), struct.Struct("3i")
"""Process, user and group of a peer (unix(7))."""


class _UnixConnection(http.client.HTTPConnection):
    def __init__(self, path: Path, timeout_s: float) -> None:
        super().__init__("localhost", timeout=timeout_s)
        self._path = path

    def connect(self) -> None:
        """Connect to the socket."""
        self.sock = _connect(self._path)
        self.sock.settimeout(self.timeout)


def _connect(path: Path) -> socket.socket:
    """Return a connection to a trusted server: this user, root, or the folder's owner. Raises OSError, HostRefusal."""
    try:
        trusted_users = trusted_owners(path.parent)
    except UntrustedPath as error:
        raise host_refusal(error) from None
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        # A connection attempt waits for its turn only on a socket that blocks (unix(7)).
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _TIMEVAL.pack(round(TIMEOUT_S), 0))
        connection.connect(str(path))
        connection.settimeout(TIMEOUT_S)
        _, server_user, _ = _CREDENTIALS.unpack(
            connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        )
        owner = path.lstat().st_uid
        if server_user not in trusted_users or owner != server_user:
            raise HostRefusal(
                f"{path}: served by user {server_user} on a socket of user {owner}, not of its folder's owner"
            )
        return connection
    except BaseException:
        connection.close()
        raise


class NoAnswer(UnavailableError):
    """No service answers at a control socket; `reason` is the cause in words, without the path."""

    def __init__(self, path: Path, error: Exception) -> None:
        match error:
            case FileNotFoundError():
                self.reason = "it was stopped, or never started"
            case ConnectionRefusedError():
                self.reason = "it has died: no process listens at its socket"
            case OSError():
                self.reason = error.strerror or str(error)
            case _:
                self.reason = "it ended the connection in the middle of an answer"
        super().__init__(f"{path}: no service answers there ({self.reason})")


class Disconnector:
    """Means to end one exchange from another thread; a measurement ends with its client's connection."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._connection: socket.socket | None = None
        self._is_ended = False

    def attach(self, connection: socket.socket) -> None:
        """Set the connection of the exchange; close it at once if `disconnect` was called before."""
        with self._lock:
            self._connection = connection
            if self._is_ended:
                _shut_down(connection)

    def disconnect(self) -> None:
        """Close the connection, now or once it is attached; the waiting `exchange` raises NoAnswer."""
        with self._lock:
            self._is_ended = True
            if self._connection is not None:
                _shut_down(self._connection)


def _shut_down(connection: socket.socket) -> None:
    """Close both directions of a connection; a closed one is left alone."""
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class Client:
    """Client of the service at `path`; requests carry `name` unless it is None."""

    def __init__(self, path: Path, name: str | None = None) -> None:
        self.path, self._name = path, name

    def get(self, resource: str) -> Any:
        """Return the answer to a GET request: JSON values, or text. Raises UnavailableError, RtloopError."""
        return self._request("GET", resource, None)

    def post(self, resource: str, body: Mapping[str, Any] | None = None, timeout_s: float = TIMEOUT_S) -> Any:
        """Return the answer to a POST request. Raises UnavailableError, or RtloopError with the service's message."""
        return self._request("POST", resource, json.dumps(body or {}), timeout_s)

    def delete(self, resource: str) -> Any:
        """Return the answer to a DELETE request; raises as `post`."""
        return self._request("DELETE", resource, None)

    def lock(self, emergency_key: str | None = None) -> Any:
        """Take the lock, from its holder with the emergency key. Returns the lock holder; raises as `post`."""
        return self.post("/lock", {} if emergency_key is None else {"emergency_key": emergency_key})

    def move(self, resource: str, body: Mapping[str, Any], timeout_s: float) -> Any:
        """Post a request that moves an axis; Ctrl-C restores the reference before it and raises LoopFault.

        Raises otherwise as `post`.
        """
        axis = body["axis"]
        held_um = self.get("/status").get("axes", {}).get(axis, {}).get("reference_um")
        try:
            return self.post(resource, body, timeout_s)
        except KeyboardInterrupt:
            if held_um is None:
                raise LoopFault("interrupted") from None
            try:
                self.post("/setpoint", {"axis": axis, "value": held_um})
            except RtloopError as error:
                raise LoopFault(f"interrupted; the service ends it, and no setpoint was taken: {error}") from None
            raise LoopFault(f"interrupted; axis {axis} holds {held_um:g} µm as before") from None

    def watch(self) -> Iterator[dict[str, Any]]:
        """Yield the newest signals, about 20 times a second. Raises UnavailableError."""
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

        try:
            with connect("ws://localhost/watch", sock=_connect(self.path)) as connection:
                for message in connection:
                    yield json.loads(message)
        except (OSError, WebSocketException) as error:
            raise NoAnswer(self.path, error) from None

    def exchange(
        self,
        method: str,
        resource: str,
        body: str | bytes | None,
        timeout_s: float = TIMEOUT_S,
        hang_up: Disconnector | None = None,
    ) -> tuple[int, str, bytes]:
        """Return status code, content type and body of an answer; `hang_up` lets another thread end the exchange.

        Raises UnavailableError, HostRefusal.
        """
        connection = _UnixConnection(self.path, timeout_s)
        try:
            if hang_up is not None:
                connection.connect()
                hang_up.attach(connection.sock)
            connection.request(method, resource, body, {"Content-Type": "application/json"})
            response = connection.getresponse()
            return response.status, response.getheader("Content-Type") or "", response.read()
        except (OSError, http.client.HTTPException) as error:
            raise NoAnswer(self.path, error) from None
        finally:
            connection.close()

    def _request(self, method: str, resource: str, body: str | None, timeout_s: float = TIMEOUT_S) -> Any:
        """Send a request, with the client's name unless it is a GET. Returns JSON values or text; raises as `post`."""
        if self._name is not None and method != "GET":
            resource = f"{resource}?as={quote(self._name, safe='', errors='replace')}"
        status, content_type, data = self.exchange(method, resource, body, timeout_s)
        answer = json.loads(data) if "json" in content_type else data.decode()
        if status >= 400:
            raise RtloopError(answer["error"] if isinstance(answer, dict) else f"{status} {answer}")
        return answer
