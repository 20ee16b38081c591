"""Messages to viewers, decoded by an independent decoder and by Foxglove's packages."""

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
from tests.panel.served import Served

NAMES = ("tick", "x_position_um", "x_drive_v", "y_position_um")
LOOP: Any = SimpleNamespace(names=NAMES, rate_hz=1e4)
TOKEN = "a-token-of-the-panel"
PACKAGES = Path(os.environ.get("RTLOOP_NODE_PACKAGES") or Path(__file__).parents[3] / "build" / "node")
NEEDED = ("ws", "@foxglove/ws-protocol", "@foxglove/rosmsg", "@foxglove/rosmsg2-serialization")


def decoded(schema: str, data: bytes) -> dict[str, Any]:
    """A message by its schema, as the OMG's CDR says (version 1, little-endian)."""
    top, *others = schema.split("=" * 80 + "\n")
    types = {text.split("\n")[0].removeprefix("MSG: "): text.split("\n", 1)[1] for text in others}
    sizes = {"int32": "i", "uint32": "I", "uint64": "Q", "float64": "d"}
    assert data[:4] == b"\x00\x01\x00\x00"
    body, place = data[4:], 0

    def scalar(code: str) -> Any:
        nonlocal place
        size = struct.calcsize(code)
        place += -place % size
        (value,) = struct.unpack_from(f"<{code}", body, place)
        place += size
        return value

    def read(fields: str) -> dict[str, Any]:
        nonlocal place
        found: dict[str, Any] = {}
        for kind, name in (line.split() for line in fields.strip().split("\n")):
            if kind == "string":
                length = scalar("I")
                found[name] = body[place : place + length - 1].decode()
                assert body[place + length - 1] == 0
                place += length
            else:
                found[name] = scalar(sizes[kind]) if kind in sizes else read(types[kind])
        return found

    message = read(top)
    assert place == len(body)
    return message


def test_live_messages_decode_to_their_extremes():
    extremes = np.array([[-1.5, 2.0, 0.25], [math.nan, math.inf, -0.0]])
    data = cdr.live_message(1_234_567_890_123_456_789, 77, 12, 3, extremes)
    said = decoded(cdr.live_schema(["x_position_um", "X_2"]), data)
    assert said["stamp"] == {"sec": 1_234_567_890, "nanosec": 123_456_789}
    assert (said["tick"], said["ticks"], said["lost"]) == (77, 12, 3)
    assert said["x_position_um"] == {"min": -1.5, "max": 2.0, "last": 0.25}
    assert list(map(repr, said["X_2"].values())) == ["nan", "inf", "-0.0"]


@pytest.mark.parametrize("text", ["", "a", "abcd", "µm → ü", "a\0b", "x" * 1000])
def test_event_messages_decode_to_their_texts(text: str):
    said = decoded(cdr.event_schema(), cdr.event_message(5_000_000_001, 9, "trip", text, "", f'{{"a": "{text}"}}'))
    assert said["stamp"] == {"sec": 5, "nanosec": 1}
    clean = text.replace("\0", "")
    assert [said[name] for name in ("tick", *cdr.EVENT_TEXTS)] == [9, "trip", clean, "", f'{{"a": "{clean}"}}']


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
        if end % 4 == 0 and (taken := digest.take()) is not None:
            part = rows[begin:end, 1:]
            assert (taken.tick, taken.ticks) == (end - 1, end - begin)
            expected = np.column_stack([np.nanmin(part, axis=0), np.nanmax(part, axis=0), part[-1]])
            np.testing.assert_array_equal(taken.extremes, expected)
            begin = end
    assert begin == 5000
    assert digest.take() is None


class Feed:
    """A loop whose signals are known: at tick n the position is n, the drive −n, and y is nothing."""

    def __init__(self) -> None:
        self.lock, self.viewers, self.tick = threading.Lock(), [], 0
        self.kept: list[tuple[int, dict[str, Any]]] = []
        self.events: Any = SimpleNamespace(events_after=self.events_after, newest=0)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def events_after(self, number: int) -> list[tuple[int, dict[str, Any]]]:
        return [one for one in list(self.kept) if one[0] > number]

    def say(self, kind: str, tick: int) -> None:
        event = {"tick": tick, "kind": kind, "who": "ada", "axis": None, "what": {"mode": "off"}}
        self.kept.append((len(self.kept) + 1, event))
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

    def _work(self) -> None:
        while not self._ending.wait(0.005):
            tick = np.arange(self.tick, self.tick + 50, dtype=float)
            rows = np.column_stack([tick, tick, -tick, np.full(50, np.nan)])
            with self.lock:
                for viewer in self.viewers:
                    viewer.feed(Stretch(NAMES, self.tick, rows), ())
            self.tick += 50


class Server:
    """The endpoint at a port of its own."""

    def __init__(self) -> None:
        self.feed = Feed()
        foxglove = Foxglove(self.feed, viewers_token(TOKEN), "lab")  # type: ignore[arg-type]
        self._served = Served([foxglove.route])
        self.address = f"ws://127.0.0.1:{self._served.port}{PATH}?token={viewers_token(TOKEN)}"

    def close(self) -> None:
        self._served.close()
        self.feed.stop()

    def viewer(self, *protocols: str) -> ClientConnection:
        spoken = [Subprotocol(name) for name in protocols or PROTOCOLS[:1]]
        return connect(self.address, subprotocols=spoken)


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.close()


def begun(viewer: ClientConnection, name: str = "lab") -> dict[str, dict[str, Any]]:
    """What is advertised, by topic."""
    info = json.loads(viewer.recv(10))
    assert (info["op"], info["name"], info["capabilities"]) == ("serverInfo", name, [])
    channels: dict[str, dict[str, Any]] = {}
    while len(channels) < 2:
        said = json.loads(viewer.recv(10))
        assert said["op"] == "advertise"
        channels |= {channel["topic"]: channel for channel in said["channels"]}
    return channels


def subscribe(viewer: ClientConnection, *pairs: tuple[int, int]) -> None:
    asked = [{"id": number, "channelId": channel} for number, channel in pairs]
    viewer.send(json.dumps({"op": "subscribe", "subscriptions": asked}))


def test_a_viewer_receives_its_subscriptions(server: Server):
    with server.viewer("other", *PROTOCOLS) as viewer:
        assert viewer.subprotocol == PROTOCOLS[0]
        channels = begun(viewer)
        live, events = channels["/live"], channels["/events"]
        for channel, name in ((live, "rtloop/msg/Live"), (events, "rtloop/msg/Event")):
            said = channel["encoding"], channel["schemaEncoding"], channel["schemaName"]
            assert said == ("cdr", "ros2msg", name)
        subscribe(viewer, (7, live["id"]))
        ticks, stamps = [], []
        for _ in range(20):
            data = viewer.recv(10)
            assert isinstance(data, bytes)
            opcode, number, stamp_ns = struct.unpack_from("<BIQ", data)
            said = decoded(live["schema"], data[13:])
            assert (opcode, number) == (1, 7)
            assert stamp_ns == said["stamp"]["sec"] * 10**9 + said["stamp"]["nanosec"]
            first, last = said["tick"] + 1 - said["ticks"], said["tick"]
            assert said["x_position_um"] == {"min": first, "max": last, "last": last}
            assert said["x_drive_v"] == {"min": -last, "max": -first, "last": -last}
            assert all(math.isnan(value) for value in said["y_position_um"].values())
            ticks += [first, last]
            stamps.append(stamp_ns)
        assert [end + 1 for end in ticks[1:-1:2]] == ticks[2::2]  # every tick is in one message
        assert stamps == sorted(stamps)
        viewer.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [7]}))
        subscribe(viewer, (8, events["id"]))
        wait_for(lambda: silent(viewer), "nothing more of what was unsubscribed")
        server.feed.say("set_mode", 42)
        server.feed.say("tripped", 43)
        for kind, tick in (("set_mode", 42), ("tripped", 43)):
            data = viewer.recv(10)
            assert isinstance(data, bytes)
            said = decoded(events["schema"], data[13:])
            assert (data[1], said["tick"], said["kind"], said["who"]) == (8, tick, kind, "ada")
            assert json.loads(said["what"]) == {"mode": "off"}


def silent(viewer: ClientConnection) -> bool:
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
    with server.viewer() as viewer:
        begun(viewer)
        viewer.send(message if isinstance(message, bytes | str) else json.dumps(message))
        said = json.loads(viewer.recv(10))
        assert (said["op"], said["level"], bool(said["message"])) == ("status", 1, True)
    wait_for(lambda: not server.feed.viewers, "its end")


def test_a_viewer_that_stops_reading_is_dropped(server: Server, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("rtloop.panel.foxglove.endpoint.SEND_TIMEOUT_S", 0.2)
    told: list[dict[str, Any]] = []

    async def serve() -> None:
        advertised = asyncio.Event()
        said = iter([{"type": "websocket.connect"}])

        async def receive() -> dict[str, Any]:
            if (first := next(said, None)) is not None:
                return first
            await advertised.wait()
            if told[-1].get("text", "").count("/live"):
                told.append({})
                asked = {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 2}]}
                return {"type": "websocket.receive", "text": json.dumps(asked)}
            return await asyncio.get_running_loop().create_future()

        async def send(message: Any) -> None:
            told.append(message)
            if "/live" in message.get("text", ""):
                advertised.set()
            if "bytes" in message:
                await asyncio.get_running_loop().create_future()  # its buffers are full

        scope = {"type": "websocket", "path": PATH, "subprotocols": [PROTOCOLS[0]], "headers": [], "query_string": b""}
        viewer = WebSocket(scope, receive, send)
        await asyncio.wait_for(Foxglove(server.feed, "").serve(viewer), 30)  # type: ignore[arg-type]

    asyncio.run(serve())
    assert sum("bytes" in message for message in told) == 1
    assert told[-1]["type"] == "websocket.close"
    assert not server.feed.viewers


def test_other_protocols_and_viewers_beyond_the_limit_are_refused(server: Server):
    for protocols in (("graphql-ws",), ("foxglove.websocket.v0",)):
        with pytest.raises((InvalidStatus, ConnectionClosed)), server.viewer(*protocols):
            pass
    with ExitStack() as viewers:
        for _ in range(MAX_VIEWERS):
            viewers.enter_context(server.viewer())
        with pytest.raises((InvalidStatus, ConnectionClosed)), server.viewer():
            pass
    wait_for(lambda: not server.feed.viewers, "their end")
    with server.viewer(PROTOCOLS[1]) as viewer:
        assert viewer.subprotocol == PROTOCOLS[1]
        begun(viewer)


@pytest.mark.parametrize(
    ("query", "let_in"),
    [
        (f"token={viewers_token(TOKEN)}", True),
        (f"token={TOKEN}", False),
        (f"token={viewers_token(TOKEN)}&token=x", False),
        ("token=", False),
        ("", False),
        ("token=%ff", False),
    ],
)
def test_only_the_token_admits_a_viewer(server: Server, query: str, let_in: bool):
    foxglove = Foxglove(server.feed, viewers_token(TOKEN))  # type: ignore[arg-type]
    scope = {"type": "websocket", "path": PATH, "query_string": query.encode()}
    assert foxglove.admits(scope) is let_in
    assert not foxglove.admits(scope | {"type": "http"})
    assert not foxglove.admits(scope | {"path": "/live"})


def test_with_foxglove_s_own_client(server: Server):
    node = shutil.which("node")
    missing = [name for name in NEEDED if not (PACKAGES / "node_modules" / name).is_dir()]
    if node is None or missing:
        pytest.skip("node is not installed" if node is None else f"not installed: {', '.join(missing)}; `make tools`")
    script, before = Path(__file__).parent / "client.mjs", server.feed.tick
    heard = threading.Event()

    def talk() -> None:
        while not heard.wait(0.2):
            server.feed.say("set_mode", 1234)

    talker = threading.Thread(target=talk)
    talker.start()
    try:
        command = [node, script, PACKAGES, server.address, "150"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    finally:
        heard.set()
        talker.join()
    said = json.loads(done.stdout)
    assert (said["info"]["name"], said["status"]) == ("lab", [])
    assert {channel["topic"]: channel["schemaName"] for channel in said["channels"]} == {
        "/live": "rtloop/msg/Live",
        "/events": "rtloop/msg/Event",
    }
    live = [one["message"] for one in said["messages"] if one["topic"] == "/live"]
    assert live[0]["tick"] >= before
    for one in live:
        first, last = one["tick"] + 1 - one["ticks"], one["tick"]
        assert one["x_position_um"] == {"min": first, "max": last, "last": last}
        assert one["x_drive_v"] == {"min": -last, "max": -first, "last": -last}
        assert abs(one["stamp"]["sec"] - time.time()) < 600
    assert [end["tick"] + 1 - end["ticks"] for end in live[1:]] == [one["tick"] + 1 for one in live[:-1]]
    event = next(one["message"] for one in said["messages"] if one["topic"] == "/events")
    assert (event["tick"], event["kind"], event["who"], event["what"]) == (1234, "set_mode", "ada", '{"mode": "off"}')
