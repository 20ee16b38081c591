"""A client that takes nothing is dropped, and nothing stays of it; frames are made when they can be sent."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import anyio
import pytest

from rtloop.panel.views.feed import Feed
from rtloop.panel.views.link import Service
from rtloop.panel.views.state import State
from rtloop.panel.web import live
from rtloop.panel.web.live import Live


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
def test_it_is_dropped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, goes: bool):
    monkeypatch.setattr(live, "TAKE_S", 0.2)
    service = Service(tmp_path / "none.sock")
    feed = Feed(service)
    made = []
    served = Live(feed, State(service.client))
    monkeypatch.setattr(live.Viewer, "due", lambda self: made.append(self) or [b"frame"])
    client = Client(3, goes)

    async def serve() -> None:
        with anyio.fail_after(20):
            await served.serve(client)  # type: ignore[arg-type]

    anyio.run(serve)
    assert client.closed
    assert (client.taken, len(made)) == (3, 4)
    assert served._streams == 0
    assert feed._viewers == []
