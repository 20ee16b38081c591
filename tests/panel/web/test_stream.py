"""A client that stops reading is dropped without a trace; frames are made only when they can be sent."""

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
from tests.panel.route_server import RouteServer


class WebSocketStub:
    """WebSocket whose client reads `max_frames` frames, and then reads no more or disconnects."""

    def __init__(self, max_frames: int, disconnects: bool = False) -> None:
        self.max_frames, self.disconnects, self.sent, self.closed = max_frames, disconnects, 0, False

    async def accept(self, _: str) -> None:
        """Accept the connection at once."""

    async def receive(self) -> dict[str, Any]:
        await anyio.sleep_forever()
        raise AssertionError

    async def send_bytes(self, _: bytes) -> None:
        """Count a frame; after `max_frames` frames, block for ever or raise OSError."""
        if self.sent == self.max_frames:
            if self.disconnects:
                raise OSError("gone")
            await anyio.sleep_forever()
        self.sent += 1

    async def close(self, _: int) -> None:
        self.closed = True


@pytest.mark.parametrize("disconnects", [False, True])
def test_a_client_that_stops_reading_is_dropped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, disconnects: bool):
    monkeypatch.setattr(live, "SEND_TIMEOUT_S", 0.2)
    service = Service(tmp_path / "none.sock")
    feed = Feed(service)
    frames_made = []
    endpoint = Live(feed, StateListener(service.client))
    monkeypatch.setattr(live.Viewer, "due_frames", lambda self: frames_made.append(self) or [b"frame"])
    client = WebSocketStub(3, disconnects)

    async def serve() -> None:
        with anyio.fail_after(20):
            await endpoint.serve(client)  # type: ignore[arg-type]

    anyio.run(serve)
    assert client.closed
    assert (client.sent, len(frames_made)) == (3, 4)
    assert endpoint._streams == 0
    assert feed._viewers == []


def test_a_connection_that_ended_is_not_aborted(monkeypatch: pytest.MonkeyPatch):
    """The client reads all that was sent after the close, so that the connection ends before it would be aborted."""
    outcomes: Queue[Exception | None] = Queue()

    class EndedStream(Stream):
        """Stream that calls `cut` after its connection has ended, and puts the error or None in `outcomes`."""

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            self.loop.call_soon(self.cut_ended)

        def cut_ended(self) -> None:
            """Cut the ended connection and store the outcome."""
            try:
                outcomes.put(self.cut())
            except AttributeError as error:
                outcomes.put(error)

    async def send_16_mib(socket: WebSocket) -> None:
        await socket.accept()
        await socket.send_bytes(bytes(1 << 24))

    monkeypatch.setattr(live, "CLOSE_S", 60.0)
    server = RouteServer([WebSocketRoute("/", send_16_mib)], ws=EndedStream, ws_per_message_deflate=False)
    with connect(f"ws://127.0.0.1:{server.port}/", max_size=None, close_timeout=0.1) as client:
        assert len(client.recv()) == 1 << 24
        assert outcomes.get(timeout=60) is None
    server.close()
