"""A client that stops reading is dropped and leaves nothing behind; frames are made when they can be sent."""

from __future__ import annotations

from pathlib import Path
from queue import Queue
from typing import Any

import anyio
import pytest
from starlette.routing import WebSocketRoute
from starlette.websockets import WebSocket
from websockets.sync.client import connect

from rtloop.panel.feed.feed import Feed
from rtloop.panel.service.service import Service
from rtloop.panel.service.state import StateListener
from rtloop.panel.web import live
from rtloop.panel.web.live import Live, Stream
from tests.panel.served import Served


class Client:
    """A WebSocket whose client takes `takes` frames and then nothing, or goes."""

    def __init__(self, takes: int, goes: bool = False) -> None:
        self.left, self.goes, self.taken, self.closed = takes, goes, 0, False

    async def accept(self) -> None:
        """At once."""

    async def receive(self) -> dict[str, Any]:
        await anyio.sleep_forever()
        raise AssertionError

    async def send_bytes(self, _: bytes) -> None:
        if self.taken == self.left:
            if self.goes:
                raise OSError("gone")
            await anyio.sleep_forever()
        self.taken += 1

    async def close(self, _: int) -> None:
        self.closed = True


@pytest.mark.parametrize("goes", [False, True])
def test_a_client_that_stops_reading_is_dropped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, goes: bool):
    monkeypatch.setattr(live, "SEND_TIMEOUT_S", 0.2)
    service = Service(tmp_path / "none.sock")
    feed = Feed(service)
    made = []
    served = Live(feed, StateListener(service.client))
    monkeypatch.setattr(live.Viewer, "due_frames", lambda self: made.append(self) or [b"frame"])
    client = Client(3, goes)

    async def serve() -> None:
        with anyio.fail_after(20):
            await served.serve(client)  # type: ignore[arg-type]

    anyio.run(serve)
    assert client.closed
    assert (client.taken, len(made)) == (3, 4)
    assert served._streams == 0
    assert feed._viewers == []


def test_a_connection_that_ended_is_not_aborted(monkeypatch: pytest.MonkeyPatch):
    """It took what was left for it after it was closed, and the connection ended by itself."""
    tried: Queue[Exception | None] = Queue()

    class Cut(Stream):
        """As soon as it has gone."""

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            self.loop.call_soon(self.again)

        def again(self) -> None:
            try:
                tried.put(self.cut())
            except AttributeError as error:
                tried.put(error)

    async def much(socket: WebSocket) -> None:
        await socket.accept()
        await socket.send_bytes(bytes(1 << 24))

    monkeypatch.setattr(live, "CLOSE_S", 60.0)
    served = Served([WebSocketRoute("/", much)], ws=Cut, ws_per_message_deflate=False)
    with connect(f"ws://127.0.0.1:{served.port}/", max_size=None, close_timeout=0.1) as client:
        assert len(client.recv()) == 1 << 24
        assert tried.get(timeout=60) is None
    served.close()
