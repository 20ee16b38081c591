"""`/foxglove`: signals and events for viewers of the Foxglove WebSocket protocol, which can send no commands.

Channels, both CDR with a schema of the kind ros2msg:

    /live     RATE_HZ times a second: extremes and last value of each signal since the previous message
    /events   commands, changes of mode and trips, when they happen

https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md. A viewer runs in another page and sends no header of
ours: a token in its address admits it, which is derived from the panel's token and allows no commands.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import struct
from collections.abc import Mapping
from contextlib import suppress
from urllib.parse import parse_qs

import anyio.to_thread
from starlette.routing import WebSocketRoute
from starlette.types import Scope
from starlette.websockets import WebSocket, WebSocketDisconnect

from rtloop.foundation import timing
from rtloop.panel.feed.feed import Feed
from rtloop.panel.foxglove import cdr
from rtloop.panel.foxglove.digest import Digest, SignalDigest
from rtloop.panel.foxglove.subscriptions import Channel, Subscriptions
from rtloop.panel.protocol.frames import SEND_TIMEOUT_S

PATH = "/foxglove"
PROTOCOLS = ("foxglove.websocket.v1", "foxglove.sdk.v1")
RATE_HZ, EVENTS_HZ = 50.0, 8.0
"""Rates of the channels; viewers warn above 60 messages a second in all."""
MAX_VIEWERS = 4
REQUESTS_PER_S = 20.0
MESSAGE_DATA = struct.Struct("<BIQ")
WARNING = 1


def viewers_token(token: str) -> str:
    """Return the token of viewers, derived from the panel's; it admits a viewer and allows no command."""
    return hmac.new(token.encode(), b"viewers", hashlib.sha256).hexdigest()[:32]


EVENTS = Channel(1, "/events", cdr.EVENT, cdr.event_schema())


class Foxglove:
    """The endpoint for viewers whose address contains `token`, made by `viewers_token`; `name` is the server's name."""

    def __init__(self, feed: Feed, token: str, name: str = "rtloop") -> None:
        """Store the feed, the viewers' token, which is not the panel's, and the name of the server."""
        self._feed, self._name, self._token = feed, name, token
        self._viewers = 0

    @property
    def route(self) -> WebSocketRoute:
        """Route `/foxglove` of the endpoint."""
        return WebSocketRoute(PATH, self.serve)

    def admits(self, scope: Scope) -> bool:
        """Return whether a request is a WebSocket to PATH with the viewers' token in its address, from any origin."""
        if scope["type"] != "websocket" or scope["path"] != PATH:
            return False
        tokens = parse_qs(scope["query_string"].decode("latin-1"), max_num_fields=8).get("token", [""])
        return len(tokens) == 1 and hmac.compare_digest(tokens[0].encode(errors="replace"), self._token.encode())

    async def serve(self, socket: WebSocket) -> None:
        """Serve one viewer until it disconnects or stops reading.

        Refuse it with code 1013 beyond MAX_VIEWERS, with code 1002 without one of PROTOCOLS.
        """
        protocol = next((offered for offered in socket.scope["subprotocols"] if offered in PROTOCOLS), None)
        if protocol is None or self._viewers >= MAX_VIEWERS:
            await socket.close(1002 if protocol is None else 1013)
            return
        self._viewers += 1
        viewer = _Viewer(socket, self._feed, self._name)
        try:
            await socket.accept(protocol)
            await viewer.serve()
        finally:
            self._viewers -= 1
            with suppress(RuntimeError, OSError, WebSocketDisconnect, TimeoutError):
                await asyncio.wait_for(socket.close(1001), 1.0)


class _Viewer:
    """Connection of one viewer: its subscriptions, and the number of the newest event that it received."""

    def __init__(self, socket: WebSocket, feed: Feed, name: str) -> None:
        """Begin without subscriptions; earlier events than the connection are not sent. `name` is the server's name."""
        self._socket, self._feed, self._name = socket, feed, name
        self._digest = Digest()
        self._live: Channel | None = None
        self._subscriptions = Subscriptions()
        self._sent_number = feed.events.newest
        self._event_due_s = 0.0
        self._clock = asyncio.get_running_loop().time

    async def serve(self) -> None:
        """Serve the viewer until it disconnects, or takes no message for SEND_TIMEOUT_S."""
        info = {
            "op": "serverInfo",
            "name": self._name,
            "capabilities": [],
            "sessionId": str(round(1e9 * timing.unix_s())),
        }
        await self._send_json(info)
        await self._advertise(EVENTS)
        self._feed.add_viewer(self._digest)
        try:
            tasks = {asyncio.create_task(work()) for work in (self._listen, self._send_messages)}
            _, pending = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in pending:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        finally:
            self._feed.remove_viewer(self._digest)

    async def _listen(self) -> None:
        """Carry out the viewer's messages, at most REQUESTS_PER_S a second, until it disconnects.

        An invalid message is reported to the viewer.

        Messages that come faster wait unread.
        """
        while True:
            message = await self._socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            if fault := self._subscriptions.handle_message(message.get("text")):
                await self._send_json({"op": "status", "level": WARNING, "message": fault})
            await asyncio.sleep(1 / REQUESTS_PER_S)

    async def _send_messages(self) -> None:
        """Send the digest of new ticks RATE_HZ times a second, and events, for ever.

        Announces a new channel /live whenever the loop has other signals. Raises TimeoutError if the viewer does not
        take a message within SEND_TIMEOUT_S.
        """
        due_s = self._clock()
        while True:
            names, generation, digest = await anyio.to_thread.run_sync(self._take_digest)
            if generation and (self._live is None or self._live.id != EVENTS.id + generation):
                await self._replace_channel(Channel(EVENTS.id + generation, "/live", cdr.LIVE, cdr.live_schema(names)))
            now_ns = round(1e9 * timing.unix_s())
            if digest is not None and self._live is not None:
                await self._send(self._live, now_ns, cdr.live_message(now_ns, *digest))
            await self._send_event(now_ns)
            due_s = max(due_s + 1 / RATE_HZ, self._clock())
            await asyncio.sleep(due_s - self._clock())

    def _take_digest(self) -> tuple[tuple[str, ...], int, SignalDigest | None]:
        """Return signal names, generation and the digest of all ticks since the last call (None without ticks).

        The feed's lock is held meanwhile.
        """
        with self._feed.lock:
            return self._digest.names, self._digest.generation, self._digest.take()

    async def _send_event(self, now_ns: int) -> None:
        """Send the oldest unsent event, if there is one, with the UNIX time `now_ns`; at most EVENTS_HZ a second."""
        if self._clock() < self._event_due_s:
            return
        if not (events := self._feed.events.events_after(self._sent_number)):
            return
        self._sent_number, event = min(events, key=lambda row: row[0])
        texts = event["kind"], event["who"], event["axis"] or "", json.dumps(event["what"])
        await self._send(EVENTS, now_ns, cdr.event_message(now_ns, event["tick"], *texts))
        self._event_due_s = self._clock() + 1 / EVENTS_HZ

    async def _replace_channel(self, live: Channel) -> None:
        """Withdraw the channel /live with its subscriptions, and announce `live`: the loop has other signals."""
        previous, self._live = self._live, live
        if previous is not None:
            self._subscriptions.withdraw(previous.id)
            await self._send_json({"op": "unadvertise", "channelIds": [previous.id]})
        await self._advertise(live)

    async def _advertise(self, channel: Channel) -> None:
        """Announce a channel to the viewer, which may then subscribe to it. Raises TimeoutError like `_send_json`."""
        self._subscriptions.channel_ids.add(channel.id)
        await self._send_json({"op": "advertise", "channels": [channel._asdict()]})

    async def _send(self, channel: Channel, stamp_ns: int, message: bytes) -> None:
        """Send the CDR `message`, with the UNIX time `stamp_ns`, to each of the viewer's subscriptions to a channel.

        Raises TimeoutError after SEND_TIMEOUT_S.
        """
        for number in self._subscriptions.numbers_for_channel(channel.id):
            data = MESSAGE_DATA.pack(1, number, stamp_ns) + message
            await asyncio.wait_for(self._socket.send_bytes(data), SEND_TIMEOUT_S)

    async def _send_json(self, message: Mapping[str, object]) -> None:
        """Send a JSON text. Raises TimeoutError after SEND_TIMEOUT_S."""
        await asyncio.wait_for(self._socket.send_text(json.dumps(message)), SEND_TIMEOUT_S)
