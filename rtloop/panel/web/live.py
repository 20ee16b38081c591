"""`/live`: one task takes what a client wishes, one sends it what is due. A client that takes nothing is dropped."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import suppress

import anyio
import anyio.to_thread
from anyio import CancelScope, CapacityLimiter
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from rtloop.panel.views.feed import Feed
from rtloop.panel.views.state import StateListener
from rtloop.panel.views.viewer import FRAME_S, Viewer

MAX_STREAMS = 16
SEND_TIMEOUT_S = 10.0
"""A client that takes nothing for so long is dropped."""
MESSAGES_PER_S = 50.0
BUILDERS = 2
"""Threads that make frames, for all clients."""
CLOSE_S = 1.0
DISCONNECT_ERRORS = (WebSocketDisconnect, TimeoutError, RuntimeError, OSError)
"""How a client's going shows, or its taking nothing."""
Work = Callable[[WebSocket, Viewer], Awaitable[None]]


class Stream(WebSocketsSansIOProtocol):
    """A WebSocket that is cut off soon after it was closed, whatever its client has not taken by then."""

    async def run_asgi(self) -> None:
        """Serve it, then end it."""
        await super().run_asgi()
        self.loop.call_later(CLOSE_S, self.cut)

    def cut(self) -> None:
        """Cut it off, unless it has gone by itself."""
        if self in self.connections:
            self.transport.abort()

    def data_received(self, data: bytes) -> None:
        """End what is no handshake: nothing else would, before its client does."""
        super().data_received(data)
        if self.conn.handshake_exc is not None and not self.transport.is_closing():
            self.transport.abort()


class Live:
    """The endpoint."""

    def __init__(self, feed: Feed, state: StateListener) -> None:
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
            self._feed.add_viewer(viewer)
            try:
                async with anyio.create_task_group() as tasks:
                    for work in (self._listen, self._send_frames):
                        tasks.start_soon(self._run_until_end, work, socket, viewer, tasks.cancel_scope)
            finally:
                self._feed.remove_viewer(viewer)
            with suppress(*DISCONNECT_ERRORS), anyio.move_on_after(CLOSE_S):
                await socket.close(1001)
        finally:
            self._streams -= 1

    async def _run_until_end(self, work: Work, socket: WebSocket, viewer: Viewer, tasks: CancelScope) -> None:
        """The end of one is the end of the other."""
        with suppress(*DISCONNECT_ERRORS):
            await work(socket, viewer)
        tasks.cancel()

    async def _listen(self, socket: WebSocket, viewer: Viewer) -> None:
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            await anyio.to_thread.run_sync(viewer.handle_message, message.get("text") or "", limiter=self._limiter)
            await anyio.sleep(1 / MESSAGES_PER_S)

    async def _send_frames(self, socket: WebSocket, viewer: Viewer) -> None:
        clock = anyio.current_time
        due_s = clock()
        while True:
            for frame in await anyio.to_thread.run_sync(viewer.due_frames, limiter=self._limiter):
                with anyio.fail_after(SEND_TIMEOUT_S):
                    await socket.send_bytes(frame)
            due_s = max(due_s + FRAME_S, clock())
            await anyio.sleep(max(due_s - clock(), 0.0))
