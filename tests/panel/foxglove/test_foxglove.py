"""Messages to viewers decode to the known signals, with an independent decoder and with Foxglove's packages."""

from __future__ import annotations

import asyncio
import json
import math
import os
import shutil
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from starlette.websockets import WebSocket
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from rtloop.client.ticks.tick_stretch import Stretch
from rtloop.panel.foxglove import cdr
from rtloop.panel.foxglove.digest import Digest
from rtloop.panel.foxglove.endpoint import MAX_VIEWERS, PATH, PROTOCOLS, Foxglove, viewers_token
from tests.faults.evidence import wait_for
from tests.panel.route_server import RouteServer

NAMES = ("tick", "x_position_um", "x_drive_v", "y_position_um")
LOOP: Any = SimpleNamespace(names=NAMES, rate_hz=1e4)
TOKEN = "a-token-of-the-panel"
PACKAGES = Path(os.environ.get("RTLOOP_NODE_PACKAGES") or Path(__file__).parents[3] / "build" / "node")
NODE_PACKAGES = ("ws", "@foxglove/ws-protocol", "@foxglove/rosmsg", "@foxglove/rosmsg2-serialization")


def decode_message(schema: str, data: bytes) -> dict[str, Any]:
    """Return the fields of a message by its schema, decoded from the OMG's CDR (version 1, little-endian)."""
    top, *nested = schema.split("=" * 80 + "\n")
    types = {text.split("\n")[0].removeprefix("MSG: "): text.split("\n", 1)[1] for text in nested}
    sizes = {"int32": "i", "uint32": "I", "uint64": "Q", "float64": "d"}
    assert data[:4] == b"\x00\x01\x00\x00"
    body, offset = data[4:], 0

    def read_scalar(code: str) -> Any:
        """Return the next aligned number, of the type `code` of struct."""
        nonlocal offset
        size = struct.calcsize(code)
        offset += -offset % size
        (value,) = struct.unpack_from(f"<{code}", body, offset)
        offset += size
        return value

    def read_fields(fields: str) -> dict[str, Any]:
        """Return the next value of each field of a type, whose definition is `fields`."""
        nonlocal offset
        values: dict[str, Any] = {}
        for kind, name in (line.split() for line in fields.strip().split("\n")):
            if kind == "string":
                length = read_scalar("I")
                values[name] = body[offset : offset + length - 1].decode()
                assert body[offset + length - 1] == 0
                offset += length
            else:
                values[name] = read_scalar(sizes[kind]) if kind in sizes else read_fields(types[kind])
        return values

    message = read_fields(top)
    assert offset == len(body)
    return message


def test_live_messages_decode_to_their_extremes():
    extremes = np.array([[-1.5, 2.0, 0.25], [math.nan, math.inf, -0.0]])
    data = cdr.live_message(1_234_567_890_123_456_789, 77, 12, 3, extremes)
    message = decode_message(cdr.live_schema(["x_position_um", "X_2"]), data)
    assert message["stamp"] == {"sec": 1_234_567_890, "nanosec": 123_456_789}
    assert (message["tick"], message["ticks"], message["lost"]) == (77, 12, 3)
    assert message["x_position_um"] == {"min": -1.5, "max": 2.0, "last": 0.25}
    assert list(map(repr, message["X_2"].values())) == ["nan", "inf", "-0.0"]


@pytest.mark.parametrize("text", ["", "a", "abcd", "µm → ü", "a\0b", "x" * 1000])
def test_event_messages_decode_to_their_texts(text: str):
    message = decode_message(
        cdr.event_schema(), cdr.event_message(5_000_000_001, 9, "trip", text, "", f'{{"a": "{text}"}}')
    )
    assert message["stamp"] == {"sec": 5, "nanosec": 1}
    clean = text.replace("\0", "")
    assert [message[name] for name in ("tick", *cdr.EVENT_TEXTS)] == [9, "trip", clean, "", f'{{"a": "{clean}"}}']


def test_a_digest_has_the_extremes_of_stretches_of_any_length():
    random = np.random.default_rng(3)
    rows = random.normal(size=(5000, len(NAMES)))
    rows[random.random(rows.shape) < 0.1] = np.nan
    rows[:, 0] = np.arange(5000)
    digest, first, begin = Digest(), 0, 0
    digest.begin(LOOP)
    for end in (*sorted(random.choice(5000, 40, replace=False).tolist()), 5000):
        digest.feed(Stretch(NAMES, first, rows[first:end], lost=first % 3), ())
        first = end
        if end % 4 == 0 and (summary := digest.take()) is not None:
            part = rows[begin:end, 1:]
            assert (summary.tick, summary.ticks) == (end - 1, end - begin)
            expected = np.column_stack([np.nanmin(part, axis=0), np.nanmax(part, axis=0), part[-1]])
            np.testing.assert_array_equal(summary.extremes, expected)
            begin = end
    assert begin == 5000
    assert digest.take() is None


class FeedStub:
    """Feed of a loop with known signals: at tick n the position of x is n, its drive −n, and the position of y NaN."""

    def __init__(self) -> None:
        self.lock, self.viewers, self.tick = threading.Lock(), [], 0
        self.rows: list[tuple[int, dict[str, Any]]] = []
        self.events: Any = SimpleNamespace(events_after=self.events_after, newest=0)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._feed_viewers, daemon=True)
        self._thread.start()

    def events_after(self, number: int) -> list[tuple[int, dict[str, Any]]]:
        return [row for row in list(self.rows) if row[0] > number]

    def add_event(self, kind: str, tick: int) -> None:
        event = {"tick": tick, "kind": kind, "who": "ada", "axis": None, "what": {"mode": "off"}}
        self.rows.append((len(self.rows) + 1, event))
        self.events.newest += 1

    def add_viewer(self, viewer: Any) -> None:
        with self.lock:
            self.viewers.append(viewer)
            viewer.begin(LOOP)

    def remove_viewer(self, viewer: Any) -> None:
        with self.lock:
            self.viewers.remove(viewer)

    def stop(self) -> None:
        self._ending.set()
        self._thread.join()

    def _feed_viewers(self) -> None:
        """Feed all viewers 50 ticks every 5 ms until `stop`."""
        while not self._ending.wait(0.005):
            tick = np.arange(self.tick, self.tick + 50, dtype=float)
            rows = np.column_stack([tick, tick, -tick, np.full(50, np.nan)])
            with self.lock:
                for viewer in self.viewers:
                    viewer.feed(Stretch(NAMES, self.tick, rows), ())
            self.tick += 50


class Server:
    """Server of the endpoint with the signals of a FeedStub; `address` is the URL for viewers."""

    def __init__(self) -> None:
        self.feed = FeedStub()
        foxglove = Foxglove(self.feed, viewers_token(TOKEN), "lab")  # type: ignore[arg-type]
        self._server = RouteServer([foxglove.route])
        self.address = f"ws://127.0.0.1:{self._server.port}{PATH}?token={viewers_token(TOKEN)}"

    def close(self) -> None:
        self._server.close()
        self.feed.stop()

    def connect_viewer(self, *protocols: str) -> ClientConnection:
        """Connect a viewer that offers these protocols, by default the first of PROTOCOLS."""
        offered = [Subprotocol(name) for name in protocols or PROTOCOLS[:1]]
        return connect(self.address, subprotocols=offered)


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    """Yield a running server of the endpoint."""
    server = Server()
    yield server
    server.close()


def read_channels(viewer: ClientConnection, name: str = "lab") -> dict[str, dict[str, Any]]:
    """Read the first messages to a viewer; return the two advertised channels by topic."""
    info = json.loads(viewer.recv(10))
    assert (info["op"], info["name"], info["capabilities"]) == ("serverInfo", name, [])
    channels: dict[str, dict[str, Any]] = {}
    while len(channels) < 2:
        message = json.loads(viewer.recv(10))
        assert message["op"] == "advertise"
        channels |= {channel["topic"]: channel for channel in message["channels"]}
    return channels


def subscribe(viewer: ClientConnection, *pairs: tuple[int, int]) -> None:
    """Subscribe a viewer to channels, each given as (number of the subscription, number of the channel)."""
    subscriptions = [{"id": number, "channelId": channel} for number, channel in pairs]
    viewer.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))


def test_a_viewer_receives_its_subscriptions(server: Server):
    with server.connect_viewer("other", *PROTOCOLS) as viewer:
        assert viewer.subprotocol == PROTOCOLS[0]
        channels = read_channels(viewer)
        live, events = channels["/live"], channels["/events"]
        for channel, name in ((live, "rtloop/msg/Live"), (events, "rtloop/msg/Event")):
            encodings = channel["encoding"], channel["schemaEncoding"], channel["schemaName"]
            assert encodings == ("cdr", "ros2msg", name)
        subscribe(viewer, (7, live["id"]))
        ticks, stamps = [], []
        for _ in range(20):
            data = viewer.recv(10)
            assert isinstance(data, bytes)
            opcode, number, stamp_ns = struct.unpack_from("<BIQ", data)
            message = decode_message(live["schema"], data[13:])
            assert (opcode, number) == (1, 7)
            assert stamp_ns == message["stamp"]["sec"] * 10**9 + message["stamp"]["nanosec"]
            first, last = message["tick"] + 1 - message["ticks"], message["tick"]
            assert message["x_position_um"] == {"min": first, "max": last, "last": last}
            assert message["x_drive_v"] == {"min": -last, "max": -first, "last": -last}
            assert all(math.isnan(value) for value in message["y_position_um"].values())
            ticks += [first, last]
            stamps.append(stamp_ns)
        assert [end + 1 for end in ticks[1:-1:2]] == ticks[2::2]  # every tick is in one message
        assert stamps == sorted(stamps)
        viewer.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [7]}))
        subscribe(viewer, (8, events["id"]))
        wait_for(lambda: is_silent(viewer), "the end of the messages of an ended subscription")
        server.feed.add_event("set_mode", 42)
        server.feed.add_event("tripped", 43)
        for kind, tick in (("set_mode", 42), ("tripped", 43)):
            data = viewer.recv(10)
            assert isinstance(data, bytes)
            message = decode_message(events["schema"], data[13:])
            assert (data[1], message["tick"], message["kind"], message["who"]) == (8, tick, kind, "ada")
            assert json.loads(message["what"]) == {"mode": "off"}


def is_silent(viewer: ClientConnection) -> bool:
    """Return whether a viewer receives no message for 0.3 s; a received message is dropped."""
    try:
        viewer.recv(0.3)
    except TimeoutError:
        return True
    return False


@pytest.mark.parametrize(
    "message",
    [
        {"op": "advertise", "channels": [{"id": 1, "topic": "/setpoint", "encoding": "json", "schemaName": ""}]},
        {"op": "setParameters", "parameters": [{"name": "gain", "value": 1}]},
        {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 99}]},
        {"op": "subscribe", "subscriptions": [{"id": -1, "channelId": 1}]},
        {"op": "subscribe", "subscriptions": [{"id": number, "channelId": 1} for number in range(100)]},
        {"op": "subscribe"},
        {},
        [],
        "x" * 1000,
        b"\x01" * 20,
        b"",
    ],
)
def test_viewers_cannot_send_commands(server: Server, message: Any):
    with server.connect_viewer() as viewer:
        read_channels(viewer)
        viewer.send(message if isinstance(message, bytes | str) else json.dumps(message))
        status = json.loads(viewer.recv(10))
        assert (status["op"], status["level"], bool(status["message"])) == ("status", 1, True)
    wait_for(lambda: not server.feed.viewers, "the removal of the viewer")


def test_a_viewer_that_stops_reading_is_dropped(server: Server, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("rtloop.panel.foxglove.endpoint.SEND_TIMEOUT_S", 0.2)
    sent: list[dict[str, Any]] = []

    async def serve() -> None:
        """Serve a viewer that subscribes to /live and never finishes receiving its first frame."""
        advertised = asyncio.Event()
        first_messages = iter([{"type": "websocket.connect"}])

        async def receive() -> dict[str, Any]:
            if (first := next(first_messages, None)) is not None:
                return first
            await advertised.wait()
            if sent[-1].get("text", "").count("/live"):
                sent.append({})
                request = {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 2}]}
                return {"type": "websocket.receive", "text": json.dumps(request)}
            return await asyncio.get_running_loop().create_future()

        async def send(message: Any) -> None:
            sent.append(message)
            if "/live" in message.get("text", ""):
                advertised.set()
            if "bytes" in message:
                await asyncio.get_running_loop().create_future()  # The buffers of the connection are full.

        scope = {"type": "websocket", "path": PATH, "subprotocols": [PROTOCOLS[0]], "headers": [], "query_string": b""}
        viewer = WebSocket(scope, receive, send)
        await asyncio.wait_for(Foxglove(server.feed, "").serve(viewer), 30)  # type: ignore[arg-type]

    asyncio.run(serve())
    assert sum("bytes" in message for message in sent) == 1
    assert sent[-1]["type"] == "websocket.close"
    assert not server.feed.viewers


def test_other_protocols_and_viewers_beyond_the_limit_are_refused(server: Server):
    for protocols in (("graphql-ws",), ("foxglove.websocket.v0",)):
        with pytest.raises((InvalidStatus, ConnectionClosed)), server.connect_viewer(*protocols):
            pass
    with ExitStack() as viewers:
        for _ in range(MAX_VIEWERS):
            viewers.enter_context(server.connect_viewer())
        with pytest.raises((InvalidStatus, ConnectionClosed)), server.connect_viewer():
            pass
    wait_for(lambda: not server.feed.viewers, "the removal of the viewers")
    with server.connect_viewer(PROTOCOLS[1]) as viewer:
        assert viewer.subprotocol == PROTOCOLS[1]
        read_channels(viewer)


@pytest.mark.parametrize(
    ("query", "is_admitted"),
    [
        (f"token={viewers_token(TOKEN)}", True),
        (f"token={TOKEN}", False),
        (f"token={viewers_token(TOKEN)}&token=x", False),
        ("token=", False),
        ("", False),
        ("token=%ff", False),
    ],
)
def test_only_the_token_admits_a_viewer(server: Server, query: str, is_admitted: bool):
    foxglove = Foxglove(server.feed, viewers_token(TOKEN))  # type: ignore[arg-type]
    scope = {"type": "websocket", "path": PATH, "query_string": query.encode()}
    assert foxglove.admits(scope) is is_admitted
    assert not foxglove.admits(scope | {"type": "http"})
    assert not foxglove.admits(scope | {"path": "/live"})


def test_with_foxglove_s_own_client(server: Server):
    node = shutil.which("node")
    missing = [name for name in NODE_PACKAGES if not (PACKAGES / "node_modules" / name).is_dir()]
    if node is None or missing:
        pytest.skip("node is not installed" if node is None else f"not installed: {', '.join(missing)}; `make tools`")
    script, before = Path(__file__).parent / "client.mjs", server.feed.tick
    has_ended = threading.Event()

    def add_events() -> None:
        """Add an event every 0.2 s until Foxglove's client has ended."""
        while not has_ended.wait(0.2):
            server.feed.add_event("set_mode", 1234)

    event_thread = threading.Thread(target=add_events)
    event_thread.start()
    try:
        command = [node, script, PACKAGES, server.address, "150"]
        result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    finally:
        has_ended.set()
        event_thread.join()
    received = json.loads(result.stdout)
    assert (received["info"]["name"], received["status"]) == ("lab", [])
    assert {channel["topic"]: channel["schemaName"] for channel in received["channels"]} == {
        "/live": "rtloop/msg/Live",
        "/events": "rtloop/msg/Event",
    }
    live = [entry["message"] for entry in received["messages"] if entry["topic"] == "/live"]
    assert live[0]["tick"] >= before
    for message in live:
        first, last = message["tick"] + 1 - message["ticks"], message["tick"]
        assert message["x_position_um"] == {"min": first, "max": last, "last": last}
        assert message["x_drive_v"] == {"min": -last, "max": -first, "last": -last}
        assert abs(message["stamp"]["sec"] - time.time()) < 600
    assert [entry["tick"] + 1 - entry["ticks"] for entry in live[1:]] == [message["tick"] + 1 for message in live[:-1]]
    event = next(entry["message"] for entry in received["messages"] if entry["topic"] == "/events")
    assert (event["tick"], event["kind"], event["who"], event["what"]) == (1234, "set_mode", "ada", '{"mode": "off"}')
