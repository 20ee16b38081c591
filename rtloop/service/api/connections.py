"""How many clients, and how long one may keep silent: whoever speaks is heard, whatever the others do.

A connection counts as idle until a whole request has come. An idle one is closed after IDLE_S; where there are
MAX_CONNECTIONS, a new one takes the place of the oldest idle one. What is asked is answered or refused at once
(`rtloop.service.api.lanes`), so that few are ever anything but idle.
"""

from __future__ import annotations

import asyncio
import resource
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_CONNECTIONS = min(256, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 4)
IDLE_S = 10.0
BACKLOG = 64
"""Connections that are taken in one go: fewer than MAX_CONNECTIONS, so that each may speak before it is the oldest."""


class Bounded(H11Protocol):
    """One of at most `most`."""

    most = MAX_CONNECTIONS
    _open: dict[Bounded, None] = {}  # noqa: RUF012  (one event loop, one server)
    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Make room, and wait for a request."""
        super().connection_made(transport)
        self._open[self] = None
        if len(self._open) > self.most:
            oldest = next((connection for connection in self._open if connection.is_idle), self)
            oldest.drop()
        self._expect()

    def connection_lost(self, exc: Exception | None) -> None:
        """Free the place."""
        self._forget()
        super().connection_lost(exc)

    def handle_websocket_upgrade(self, event: Any) -> None:
        """A stream is no request that one waits for; it is counted where it is served."""
        self._forget()
        super().handle_websocket_upgrade(event)

    def on_response_complete(self) -> None:
        """The next request has its own time."""
        super().on_response_complete()
        self._expect()

    @property
    def is_idle(self) -> bool:
        """Whether nobody works on a request of this connection; its client is to speak, or to read."""
        return self.cycle is None or self.cycle.response_complete or self.cycle.more_body or self.flow.write_paused

    def drop(self) -> None:
        """Close it at once, whatever is on its way."""
        self._forget()
        self.transport.abort()

    def _expect(self) -> None:
        """A whole request within IDLE_S, or the end."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self.loop.call_later(IDLE_S, self._drop_idle)

    def _drop_idle(self) -> None:
        if self.is_idle:
            self.drop()
        else:
            self._expect()

    def _forget(self) -> None:
        self._open.pop(self, None)
        if self._timer is not None:
            self._timer.cancel()


def settings(application: Any) -> uvicorn.Config:
    """Of a server for a control socket."""
    return uvicorn.Config(
        application,
        http=Bounded,
        ws_max_size=1 << 16,
        log_level="warning",
        lifespan="off",
        backlog=BACKLOG,
        log_config=None,
    )
