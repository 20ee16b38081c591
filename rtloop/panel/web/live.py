"""`/live`: one task takes what a client wishes, one sends it what is due. A client that takes nothing is dropped."""

from __future__ import annotations

import asyncio
from contextlib import suppress

import anyio.to_thread
from anyio import CapacityLimiter
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from rtloop.panel.web.feed import Feed
from rtloop.panel.web.state import State
from rtloop.panel.web.viewer import FRAME_S, Viewer

MAX_STREAMS = 16
TAKE_S = 10.0
"""A client that takes nothing for so long is dropped."""
WISHES_PER_S = 50.0
BUILDERS = 2
"""Threads that make frames, for all clients."""


class Stream(WebSocketsSansIOProtocol):
    """A WebSocket that is cut off soon after it was closed, whatever its client has not taken by then."""

    async def run_asgi(self) -> None:
        """Serve it, then end it."""
        await super().run_asgi()
        self.loop.call_later(1.0, self.transport.abort)


class Live:
    """The endpoint."""

    def __init__(self, feed: Feed, state: State) -> None:
        self._feed, self._state = feed, state
        self._streams = 0
        self._limiter = CapacityLimiter(BUILDERS)

    async def serve(self, socket: WebSocket) -> None:
        """Serve one client; refuse it where there are MAX_STREAMS."""
        if self._streams >= MAX_STREAMS:
            await socket.close(1013)
            return
        self._streams += 1
        viewer = Viewer(self._feed, self._state)
        try:
            await socket.accept()
            self._feed.join(viewer)
            try:
                tasks = {asyncio.create_task(work(socket, viewer)) for work in (self._listen, self._tell)}
                _, pending = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
                for task in pending:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
            finally:
                self._feed.leave(viewer)
        finally:
            self._streams -= 1
            with suppress(RuntimeError, OSError, WebSocketDisconnect, TimeoutError):
                await asyncio.wait_for(socket.close(1001), 1.0)

    async def _listen(self, socket: WebSocket, viewer: Viewer) -> None:
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            await anyio.to_thread.run_sync(viewer.wish, message.get("text") or "", limiter=self._limiter)
            await asyncio.sleep(1 / WISHES_PER_S)

    async def _tell(self, socket: WebSocket, viewer: Viewer) -> None:
        clock = asyncio.get_running_loop().time
        due_s = clock()
        while True:
            for frame in await anyio.to_thread.run_sync(viewer.due, limiter=self._limiter):
                await asyncio.wait_for(socket.send_bytes(frame), TAKE_S)
            due_s = max(due_s + FRAME_S, clock())
            await asyncio.sleep(due_s - clock())
