"""A panel serves viewers of a real loop: only with the token, and with the values of the recording."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

import rtloop
from rtloop.client.capture.tick_capture import capture_ticks, current_run
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.panel.foxglove.test_foxglove import decode_message, read_channels, subscribe

pytestmark = pytest.mark.system

Panel = tuple[Bench, str]
OFFERED_PROTOCOLS = [Subprotocol("foxglove.websocket.v1")]


@pytest.fixture(scope="module")
def panel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Panel]:
    """Yield the bench of a running loop, and the address at which its panel serves viewers."""
    with Bench(tmp_path_factory.mktemp("viewers")) as bench:
        bench.await_drive()
        bench.rtloop("panel", bench.client.path, "--port", "0", "--foxglove")
        address = wait_for(lambda: re.search(r"ws://127\.[\d.]+:\d+/foxglove\?token=\w+", bench.log()), "an address")
        wait_for(lambda: is_admitted(address[0]), "a panel")
        yield bench, address[0]


def is_admitted(address: str, **options: Any) -> bool:
    """Return whether the panel accepts a viewer at this address; `options` go to the client."""
    try:
        with connect(address, subprotocols=OFFERED_PROTOCOLS, **options):
            return True
    except (InvalidStatus, OSError):
        return False


def test_only_viewers_with_the_token_are_admitted(panel: Panel):
    bench, address = panel
    (token,) = re.findall(r"#token=(\S+)", bench.log())
    start, viewers = address.split("?token=")
    assert is_admitted(address, origin=Origin("https://viewer.example"))
    for wrong_address in (start, f"{start}?token=", f"{start}?token={token}", f"{start}?token={viewers}x"):
        assert not is_admitted(wrong_address)
        assert not is_admitted(wrong_address, origin=Origin("https://viewer.example"))
    assert not is_admitted(address, additional_headers={"Host": "rebound.example"})
    for path in ("live", "api/status"):
        assert not is_admitted(address.replace("/foxglove", f"/{path}"))


def test_viewers_receive_the_recorded_values(panel: Panel):
    bench, address = panel
    messages = []
    with connect(address, subprotocols=OFFERED_PROTOCOLS) as viewer:
        channels = read_channels(viewer, "rtloop")
        subscribe(viewer, (1, channels["/live"]["id"]), (2, channels["/events"]["id"]))
        tick = bench.client.post("/setpoint", {"axis": "x", "value": 3.0})["tick"]
        event: dict[str, Any] | None = None
        while event is None or len(messages) < 30:
            data = viewer.recv(20)
            assert isinstance(data, bytes)
            _, number, _ = struct.unpack_from("<BIQ", data)
            if number == 1:
                messages.append(decode_message(channels["/live"]["schema"], data[13:]))
            elif (message := decode_message(channels["/events"]["schema"], data[13:]))["tick"] == tick:
                event = message
    assert (event["tick"], event["kind"], event["axis"]) == (tick, "set_reference", "x")
    assert json.loads(event["what"])["values"][1] == 3.0
    first, end = messages[0]["tick"] + 1 - messages[0]["ticks"], messages[-1]["tick"] + 1
    recording = rtloop.load(capture_ticks(bench.client, current_run(bench.client).file, first, end)["output"])
    begin = recording["tick"][0]
    for message in messages:
        rows = slice(int(message["tick"] + 1 - message["ticks"] - begin), int(message["tick"] + 1 - begin))
        for name in recording.columns[1:]:
            values = recording[name][rows]
            expected = np.fmin.reduce(values), np.fmax.reduce(values), values[-1]
            np.testing.assert_array_equal([*message[name].values()], expected)
    lost = sum(message["lost"] for message in messages[1:])  # Ticks lost before the first message do not count.
    assert sum(message["ticks"] for message in messages) + lost == end - first
