"""A client of the control API, for `rtloop ctl` and for scripts: HTTP on a UNIX socket with the standard library."""

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
LONGEST_MEASUREMENT_S = 360.0
"""How long the answer to a measurement may take: a learning may last 300 s."""
_TIMEVAL, _CREDENTIALS = struct.Struct("@ll"), struct.Struct("3i")
"""Process, user and group of a peer (unix(7))."""


class _UnixConnection(http.client.HTTPConnection):
    def __init__(self, path: Path, timeout_s: float) -> None:
        super().__init__("localhost", timeout=timeout_s)
        self._path = path

    def connect(self) -> None:
        """To the socket's path."""
        self.sock = _connected(self._path)
        self.sock.settimeout(self.timeout)


def _connected(path: Path) -> socket.socket:
    """A connection to who serves there: we, root, or whom root gave the folder to. Raises OSError, HostRefused."""
    try:
        trusted_users = trusted_owners(path.parent)
    except UntrustedPath as error:
        raise host_refusal(error) from None
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        # a connection attempt waits for its turn only on a socket that blocks (unix(7))
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


class Unanswered(UnavailableError):
    """Nobody answers at a control socket; `reason` says why, in words and without its path."""

    def __init__(self, path: Path, error: Exception) -> None:
        match error:
            case FileNotFoundError():
                self.reason = "it was stopped, or never started"
            case ConnectionRefusedError():
                self.reason = "it has died: nobody listens at its socket any more"
            case OSError():
                self.reason = error.strerror or str(error)
            case _:
                self.reason = "it broke off in the middle of an answer"
        super().__init__(f"{path}: no service answers there ({self.reason})")


class HangUp:
    """Ends one exchange from another thread: what moves an axis for a client ends with the client's connection."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._connection: socket.socket | None = None
        self._ended = False

    def take(self, connection: socket.socket) -> None:
        """Hold the connection of the exchange; it is cut at once where the exchange was ended before."""
        with self._lock:
            self._connection = connection
            if self._ended:
                _cut(connection)

    def end(self) -> None:
        """Cut the connection, now or as soon as it stands; whoever waits for the answer gets Unanswered."""
        with self._lock:
            self._ended = True
            if self._connection is not None:
                _cut(self._connection)


def _cut(connection: socket.socket) -> None:
    with suppress(OSError):  # closed already
        connection.shutdown(socket.SHUT_RDWR)


class Client:
    """Talks to the service at `path`, under a name where one is given."""

    def __init__(self, path: Path, name: str | None = None) -> None:
        self.path, self._name = path, name

    def get(self, resource: str) -> Any:
        """JSON, or text where it is none. Raises UnavailableError, RtloopError."""
        return self._request("GET", resource, None)

    def post(self, resource: str, body: Mapping[str, Any] | None = None, timeout_s: float = TIMEOUT_S) -> Any:
        """The answer. Raises UnavailableError, or RtloopError with what the service says against it."""
        return self._request("POST", resource, json.dumps(body or {}), timeout_s)

    def delete(self, resource: str) -> Any:
        """As `post`."""
        return self._request("DELETE", resource, None)

    def lock(self, emergency_key: str | None = None) -> Any:
        """Take the lock, or break it open; who holds it now. Raises as `post`."""
        return self.post("/lock", {} if emergency_key is None else {"emergency_key": emergency_key})

    def move(self, resource: str, body: Mapping[str, Any], timeout_s: float) -> Any:
        """As `post`, of what moves an axis from what it holds; at Ctrl-C that is held again. Raises LoopFault then."""
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
        """Newest signals, about 20 times a second. Raises UnavailableError."""
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

        try:
            with connect("ws://localhost/watch", sock=_connected(self.path)) as connection:
                for message in connection:
                    yield json.loads(message)
        except (OSError, WebSocketException) as error:
            raise Unanswered(self.path, error) from None

    def exchange(
        self,
        method: str,
        resource: str,
        body: str | bytes | None,
        timeout_s: float = TIMEOUT_S,
        hang_up: HangUp | None = None,
    ) -> tuple[int, str, bytes]:
        """Status, type and body of an answer, whatever they are; `hang_up` lets another thread break it off.

        Raises UnavailableError, HostRefused.
        """
        connection = _UnixConnection(self.path, timeout_s)
        try:
            if hang_up is not None:
                connection.connect()
                hang_up.take(connection.sock)
            connection.request(method, resource, body, {"Content-Type": "application/json"})
            response = connection.getresponse()
            return response.status, response.getheader("Content-Type") or "", response.read()
        except (OSError, http.client.HTTPException) as error:
            raise Unanswered(self.path, error) from None
        finally:
            connection.close()

    def _request(self, method: str, resource: str, body: str | None, timeout_s: float = TIMEOUT_S) -> Any:
        if self._name is not None and method != "GET":
            resource = f"{resource}?as={quote(self._name, safe='', errors='replace')}"
        status, content_type, data = self.exchange(method, resource, body, timeout_s)
        answer = json.loads(data) if "json" in content_type else data.decode()
        if status >= 400:
            raise RtloopError(answer["error"] if isinstance(answer, dict) else f"{status} {answer}")
        return answer
