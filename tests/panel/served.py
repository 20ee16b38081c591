"""Routes at a port of their own, for a test that asks them as a stranger does."""

from __future__ import annotations

import socket
import threading
from collections.abc import Sequence
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.routing import BaseRoute

from tests.faults.evidence import wait_for


class Served:
    """Served in a thread until `close`; `port` on 127.0.0.1."""

    def __init__(self, routes: Sequence[BaseRoute], **settings: Any) -> None:
        listening = socket.create_server(("127.0.0.1", 0))
        self.port: int = listening.getsockname()[1]
        config = uvicorn.Config(Starlette(routes=routes), log_level="critical", lifespan="off", **settings)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([listening],), daemon=True)
        self._thread.start()
        wait_for(lambda: self._server.started, "a server")

    def close(self) -> None:
        self._server.should_exit = True
        self._thread.join(30)
