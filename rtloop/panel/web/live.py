"""`/live`: for each client one task reads messages and one sends frames; a client that stops reading is dropped."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import suppress

import anyio
import anyio.to_thread
from anyio import CancelScope, CapacityLimiter
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from rtloop.panel.feed.feed import Feed
from rtloop.panel.protocol.frames import SEND_TIMEOUT_S
from rtloop.panel.service.state import StateListener
from rtloop.panel.views.viewer import FRAME_S, Viewer
from rtloop.panel.web.security import PROTOCOL

MAX_STREAMS = 16
MESSAGES_PER_S = 50.0
BUILDERS = 2
"""Threads that make frames for all clients."""
CLOSE_S = 1.0
DISCONNECT_ERRORS = (WebSocketDisconnect, TimeoutError, RuntimeError, OSError)
"""Errors of a connection whose client disconnected or stopped reading."""
Work = Callable[[WebSocket, Viewer], Awaitable[None]]


class Stream(WebSocketsSansIOProtocol):
    """A WebSocket that is aborted CLOSE_S after it was closed, even if its client has not read all of it."""

    async def run_asgi(self) -> None:
        """Serve the WebSocket, then schedule its abort CLOSE_S later."""
        await super().run_asgi()
        self.loop.call_later(CLOSE_S, self.cut)

    def cut(self) -> None:
        """Abort the connection if it is still open."""
        if self in self.connections:
            self.transport.abort()

    def data_received(self, data: bytes) -> None:
        """Process received data; an invalid handshake ends the connection, which its client could else keep open."""
        super().data_received(data)
        if self.conn.handshake_exc is not None and not self.transport.is_closing():
            self.transport.abort()


class Live:
    """The endpoint `/live` of all clients."""

    def __init__(self, feed: Feed, state: StateListener) -> None:
        """Store the sources of ticks and of the service's state; no client is connected yet."""
        self._feed, self._state = feed, state
        self._streams = 0
        self._limiter = CapacityLimiter(BUILDERS)

    async def serve(self, socket: WebSocket) -> None:
        """Serve one client until it disconnects or stops reading; beyond MAX_STREAMS, refuse it with code 1013."""
        if self._streams >= MAX_STREAMS:
            await socket.close(1013)
            return
        self._streams += 1
        viewer = Viewer(self._feed, self._state)
        try:
            await socket.accept(PROTOCOL)
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
        """Run `work`, one of a client's two tasks; its end, also by the client's disconnection, cancels both tasks."""
        with suppress(*DISCONNECT_ERRORS):
            await work(socket, viewer)
        tasks.cancel()

    async def _listen(self, socket: WebSocket, viewer: Viewer) -> None:
        """Pass the client's messages to `viewer`, at most MESSAGES_PER_S a second; return when the client disconnects.

        Messages that come faster wait unread.
        """
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            await anyio.to_thread.run_sync(viewer.handle_message, message.get("text") or "", limiter=self._limiter)
            await anyio.sleep(1 / MESSAGES_PER_S)

    async def _send_frames(self, socket: WebSocket, viewer: Viewer) -> None:
        """Send the viewer's due messages to the client every FRAME_S, for ever.

        Raises TimeoutError if the client does not take a message within SEND_TIMEOUT_S.
        """
        clock = anyio.current_time
        due_s = clock()
        while True:
            for frame in await anyio.to_thread.run_sync(viewer.due_frames, limiter=self._limiter):
                with anyio.fail_after(SEND_TIMEOUT_S):
                    await socket.send_bytes(frame)
            due_s = max(due_s + FRAME_S, clock())
            await anyio.sleep(max(due_s - clock(), 0.0))
