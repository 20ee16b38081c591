"""HTTP client of the control API on a UNIX socket, with the standard library alone."""

from __future__ import annotations

import http.client
import json
import socket
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rtloop.errors import HostRefusal, LoopFault, RtloopError, UnavailableError
from rtloop.foundation import timing
from rtloop.foundation.trusted import UntrustedPath, trusted_owners
from rtloop.supervision.paths import host_refusal

TIMEOUT_S = 20.0
BUILD_TIMEOUT_S, LONGEST_MEASUREMENT_S = 150.0, 360.0
"""Longest wait for the response to one of BUILD_RESOURCES, and to a measurement; a learning may last 300 s."""
BUILD_RESOURCES = frozenset({"/controller", "/preview", "/reload", "/tune", "/undo"})
"""Requests for which the service builds and verifies a law: these take seconds, on a busy machine tens of them."""
_TIMEVAL, _CREDENTIALS = struct.Struct("@ll"), struct.Struct("3i")
"""Seconds and microseconds of a timeout; process, user and group of a peer (unix(7))."""


class _UnixConnection(http.client.HTTPConnection):
    """HTTP connection over the UNIX socket at `path`."""

    def __init__(self, path: Path, timeout_s: float) -> None:
        """Store path and timeout; `connect` opens the connection."""
        super().__init__("localhost", timeout=timeout_s)
        self._path = path

    def connect(self) -> None:
        """Connect to the UNIX socket, and set the timeout. Raises OSError if no process listens or the system refuses,
        HostRefusal for a server or folder that is not trusted.
        """
        self.sock = _open_connection(self._path)
        self.sock.settimeout(self.timeout)


def _open_connection(path: Path) -> socket.socket:
    """Connect to the socket at `path` if a trusted user serves it: this user, root, or the owner of its folder.

    Returns the connected socket, with the timeout TIMEOUT_S. Raises OSError if no process listens or the system
    refuses, HostRefusal for a server or folder that is not trusted.
    """
    try:
        trusted_users = trusted_owners(path.parent)
    except UntrustedPath as error:
        raise host_refusal(error) from None
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        # Only a blocking socket waits for its place in the queue of connections (unix(7)).
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _TIMEVAL.pack(round(TIMEOUT_S), 0))
        connection.connect(str(path))
        connection.settimeout(TIMEOUT_S)
        _, server_user, _ = _CREDENTIALS.unpack(
            connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        )
        owner = path.lstat().st_uid
        if server_user not in trusted_users or owner != server_user:
            raise HostRefusal(
                f"{path}: user ID {owner} owns the socket, and a process of user ID {server_user} serves it; allowed: "
                "one user for both, namely you, root or the owner of the socket's folder"
            )
        return connection
    except BaseException:
        connection.close()
        raise


class UnansweredRequest(UnavailableError):
    """No service answers at a control socket; `reason` is the cause without the path, `remedy` the user's next step, or
    "".
    """

    def __init__(self, path: Path, error: Exception) -> None:
        """Set `reason` and `remedy`, and make the message, from `path`, the control socket, and `error`, which the
        connection, HTTP or the WebSocket raised.
        """
        self.remedy = "start the service with `rtloop serve CONFIG`"
        match error:
            case FileNotFoundError():
                self.reason = "the service was stopped, or never started"
            case ConnectionRefusedError():
                self.reason = "the service has died: no process listens at its socket"
                named = f" --name {path.stem}" if path.with_suffix(".hardware").exists() else ""
                self.remedy = (
                    f"make the outputs safe with `rtloop park CONFIG{named}`, unless that was done since, then start "
                    f"the service with `rtloop serve CONFIG{named}`"
                )
            case OSError():
                self.reason, self.remedy = error.strerror or str(error), ""
            case _:
                self.reason, self.remedy = "the service broke off in the middle of a response", ""
        remedy = f"; {self.remedy}" if self.remedy else ""
        super().__init__(f"{path}: no service answers at this socket ({self.reason}){remedy}")


class Cancellation:
    """Handle by which another thread ends a request of `Client.exchange`: the service then ends the motion that it made
    for this client.
    """

    def __init__(self) -> None:
        """Begin without a connection, not cancelled."""
        self._lock = timing.lock()
        self._connection: socket.socket | None = None
        self._is_cancelled = False

    def attach(self, connection: socket.socket) -> None:
        """Store the connection of the request for `cancel`; shut the connection down at once if `cancel` was called
        before. Thread-safe.
        """
        with self._lock:
            self._connection = connection
            if self._is_cancelled:
                _shut_down(connection)

    def cancel(self) -> None:
        """Shut the attached connection down, now or once `attach` has stored it; from any thread. The thread that waits
        in `Client.exchange` gets UnansweredRequest.
        """
        with self._lock:
            self._is_cancelled = True
            if self._connection is not None:
                _shut_down(self._connection)


def _shut_down(connection: socket.socket) -> None:
    """Shut a connection down in both directions, so that peer and waiting thread notice; a closed one is ignored."""
    with suppress(OSError):  # It may be closed already.
        connection.shutdown(socket.SHUT_RDWR)


class Client:
    """Sends requests to the service with the control socket `path`; commands are recorded under `name`."""

    def __init__(self, path: Path, name: str | None = None) -> None:
        """Store path and name; each request opens a connection. `name` None: the service records the name operator."""
        self.path, self._name = path, name

    def get(self, resource: str) -> Any:
        """Send GET and return the response: decoded JSON, or text if it is not JSON. Raises the errors of `post`."""
        return self._request("GET", resource, None)

    def post(self, resource: str, body: Mapping[str, object] | None = None, timeout_s: float | None = None) -> Any:
        """Send POST with a JSON body, {} for None, and return the response: decoded JSON, or text if it is not JSON.

        `timeout_s` None: waits up to TIMEOUT_S for the response, BUILD_TIMEOUT_S for BUILD_RESOURCES. Raises
        UnavailableError if no service answers in this time, HostRefusal for a service that is not trusted, RtloopError
        with the service's message if it refuses.
        """
        if timeout_s is None:
            timeout_s = BUILD_TIMEOUT_S if resource in BUILD_RESOURCES else TIMEOUT_S
        return self._request("POST", resource, json.dumps(body or {}), timeout_s)

    def delete(self, resource: str) -> object:
        """Send DELETE and return the response, decoded as by `post`. Raises the errors of `post`."""
        return self._request("DELETE", resource, None)

    def lock(self, emergency_key: str | None = None) -> Any:
        """Take the lock, or renew it; with the emergency key take it also from another holder. Raises as `post`.

        Returns the holder as in `/status`: {name, since_unix_s: start, until_unix_s: end without a further command},
        both times in s since 1970.
        """
        return self.post("/lock", {} if emergency_key is None else {"emergency_key": emergency_key})

    def measure(self, resource: str, body: Mapping[str, object], timeout_s: float = LONGEST_MEASUREMENT_S) -> Any:
        """Post a measurement that moves `body["axis"]` and return the response.

        After Ctrl-C the axis holds the value, µm, that its reference had at the call, and LoopFault is raised. If this
        value is unknown or cannot be set, the LoopFault tells the user to set it. Raises also the errors of `post`.
        """
        axis = body["axis"]
        held_um = self.get("/status").get("axes", {}).get(axis, {}).get("reference_um")
        try:
            return self.post(resource, body, timeout_s)
        except KeyboardInterrupt:
            if held_um is None:
                raise LoopFault(
                    f"the measurement was interrupted; the old reference of axis {axis} is unknown and was not "
                    f"restored; set a reference with `rtloop ctl setpoint {axis} VALUE`"
                ) from None
            try:
                self.post("/setpoint", {"axis": axis, "value": held_um})
            except RtloopError as error:
                raise LoopFault(
                    f"the measurement was interrupted; the old reference of axis {axis}, {held_um:g} µm, could not be "
                    f"restored ({error}); set it again with `rtloop ctl setpoint {axis} {held_um:g}`"
                ) from None
            raise LoopFault(f"the measurement was interrupted; axis {axis} holds {held_um:g} µm as before") from None

    def watch(self) -> Iterator[dict[str, Any]]:
        """Yield {state, faults, lock, measuring, recovery, tick, mode, trip, trip_reason, axes, condition}, each as in
        `/status`, about 20 times a second, until the service ends the connection.

        The keys from `tick` on are missing without a loop, and before its first tick. Raises UnavailableError if no
        service answers or the connection breaks, HostRefusal for a service that is not trusted.
        """
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

        try:
            with connect("ws://localhost/watch", sock=_open_connection(self.path)) as connection:
                for message in connection:
                    yield json.loads(message)
        except (OSError, WebSocketException) as error:
            raise UnansweredRequest(self.path, error) from None

    def exchange(
        self,
        method: str,
        resource: str,
        body: str | bytes | None,
        timeout_s: float = TIMEOUT_S,
        cancellation: Cancellation | None = None,
    ) -> tuple[int, str, bytes]:
        """Send one request and return (HTTP status, content type, body), also of a refusal.

        `cancellation` lets another thread end the request. Raises UnavailableError if no service answers within
        `timeout_s` or the request is cancelled, HostRefusal for a service that is not trusted.
        """
        connection = _UnixConnection(self.path, timeout_s)
        try:
            if cancellation is not None:
                connection.connect()
                cancellation.attach(connection.sock)
            connection.request(method, resource, body, {"Content-Type": "application/json"})
            response = connection.getresponse()
            return response.status, response.getheader("Content-Type") or "", response.read()
        except (OSError, http.client.HTTPException) as error:
            raise UnansweredRequest(self.path, error) from None
        finally:
            connection.close()

    def _request(self, method: str, resource: str, body: str | None, timeout_s: float = TIMEOUT_S) -> Any:
        """Send one request, under the client's name unless it is a GET. Returns the decoded response, JSON or text.

        Raises RtloopError with the service's message for a status from 400 on, and as `exchange`.
        """
        if self._name is not None and method != "GET":
            resource = f"{resource}?as={quote(self._name, safe='', errors='replace')}"
        status, content_type, data = self.exchange(method, resource, body, timeout_s)
        response = json.loads(data) if "json" in content_type else data.decode()
        if status >= 400:
            raise RtloopError(response["error"] if isinstance(response, dict) else f"{status} {response}")
        return response
