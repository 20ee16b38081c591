"""Limits on the number of connections and on their idle time, so that silent clients cannot block others.

A connection is idle while it waits for its client, to send a complete request or to read a response. An idle connection
is closed after IDLE_S. With MAX_CONNECTIONS open, a new one replaces the oldest idle one. Requests are answered or
refused quickly (`rtloop.service.api.lanes`), so almost all connections are idle.
"""

from __future__ import annotations

import asyncio
import resource
from typing import TYPE_CHECKING

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

if TYPE_CHECKING:
    import h11
    from starlette.applications import Starlette

MAX_CONNECTIONS = min(256, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 4)
IDLE_S = 10.0
BACKLOG = 64
"""Connections accepted at once: fewer than MAX_CONNECTIONS, so that a new one can send before it is the oldest."""


class BoundedConnection(H11Protocol):
    """HTTP connection, of which at most `max_connections` are open; idle ones are closed after IDLE_S."""

    max_connections = MAX_CONNECTIONS
    _open_connections: dict[BoundedConnection, None] = {}  # noqa: RUF012  (one event loop, one server)
    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Count the connection and start its idle time. Beyond `max_connections`, close the oldest idle connection at
        once, or this one if none is idle.
        """
        super().connection_made(transport)
        self._open_connections[self] = None
        if len(self._open_connections) > self.max_connections:
            oldest = next((connection for connection in self._open_connections if connection.is_idle), self)
            oldest.drop()
        self._await_request()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop counting the connection."""
        self._release_place()
        super().connection_lost(exc)

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Stop counting the connection: the application counts its WebSockets."""
        self._release_place()
        super().handle_websocket_upgrade(event)

    def on_response_complete(self) -> None:
        """Restart the idle time for the next request."""
        super().on_response_complete()
        self._await_request()

    @property
    def is_idle(self) -> bool:
        """Whether the connection waits for its client, to send a request or to read a response, and not for the
        service.
        """
        return self.cycle is None or self.cycle.response_complete or self.cycle.more_body or self.flow.write_paused

    def drop(self) -> None:
        """Close the connection at once, without sending pending data."""
        self._release_place()
        self.transport.abort()

    def _await_request(self) -> None:
        """Start the idle time: after IDLE_S the connection is closed, unless the service works on its request."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self.loop.call_later(IDLE_S, self._drop_idle)

    def _drop_idle(self) -> None:
        """Close the connection at once if it is idle, else restart its idle time."""
        if self.is_idle:
            self.drop()
        else:
            self._await_request()

    def _release_place(self) -> None:
        """Stop counting the connection, and stop the timer of its idle time."""
        self._open_connections.pop(self, None)
        if self._timer is not None:
            self._timer.cancel()


def server_settings(application: Starlette) -> uvicorn.Config:
    """Return uvicorn's configuration that serves `application` over BoundedConnections; the caller gives uvicorn's
    server its listening socket.
    """
    return uvicorn.Config(
        application,
        http=BoundedConnection,
        ws_max_size=1 << 16,
        log_level="warning",
        lifespan="off",
        backlog=BACKLOG,
        log_config=None,
    )
