"""A panel serves viewers of a real loop: access, and values against the recording."""

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
from tests.panel.foxglove.test_foxglove import begun, decoded, subscribe

Panel = tuple[Bench, str]
SPOKEN = [Subprotocol("foxglove.websocket.v1")]


@pytest.fixture(scope="module")
def panel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Panel]:
    """A loop, and the address that its panel gives viewers."""
    with Bench(tmp_path_factory.mktemp("viewers")) as bench:
        bench.await_drive()
        bench.rtloop("panel", bench.client.path, "--port", "0", "--foxglove")
        found = wait_for(lambda: re.search(r"ws://127\.0\.0\.1:\d+/foxglove\?token=\w+", bench.log()), "an address")
        wait_for(lambda: reached(found[0]), "a panel")
        yield bench, found[0]


def reached(address: str, **headers: Any) -> bool:
    try:
        with connect(address, subprotocols=SPOKEN, **headers):
            return True
    except (InvalidStatus, OSError):
        return False


def test_only_viewers_with_the_token_are_admitted(panel: Panel):
    bench, address = panel
    (token,) = re.findall(r"#token=(\S+)", bench.log())
    start, viewers = address.split("?token=")
    assert reached(address, origin=Origin("https://viewer.example"))
    for other in (start, f"{start}?token=", f"{start}?token={token}", f"{start}?token={viewers}x"):
        assert not reached(other)
        assert not reached(other, origin=Origin("https://viewer.example"))
    assert not reached(address, additional_headers={"Host": "rebound.example"})
    for path in ("live", "api/status"):
        assert not reached(address.replace("/foxglove", f"/{path}"))


def test_viewers_receive_the_recorded_values(panel: Panel):
    bench, address = panel
    messages = []
    with connect(address, subprotocols=SPOKEN) as viewer:
        channels = begun(viewer, "rtloop")
        subscribe(viewer, (1, channels["/live"]["id"]), (2, channels["/events"]["id"]))
        tick = bench.client.post("/setpoint", {"axis": "x", "value": 3.0})["tick"]
        event: dict[str, Any] | None = None
        while event is None or len(messages) < 30:
            data = viewer.recv(20)
            assert isinstance(data, bytes)
            _, number, _ = struct.unpack_from("<BIQ", data)
            if number == 1:
                messages.append(decoded(channels["/live"]["schema"], data[13:]))
            elif (said := decoded(channels["/events"]["schema"], data[13:]))["tick"] == tick:
                event = said
    assert (event["tick"], event["kind"], event["axis"]) == (tick, "set_reference", "x")
    assert json.loads(event["what"])["values"][1] == 3.0
    first, end = messages[0]["tick"] + 1 - messages[0]["ticks"], messages[-1]["tick"] + 1
    recording = rtloop.load(capture_ticks(bench.client, current_run(bench.client).file, first, end)["output"])
    begin = recording["tick"][0]
    for said in messages:
        place = slice(int(said["tick"] + 1 - said["ticks"] - begin), int(said["tick"] + 1 - begin))
        for name in recording.columns[1:]:
            values = recording[name][place]
            expected = np.fmin.reduce(values), np.fmax.reduce(values), values[-1]
            np.testing.assert_array_equal([*said[name].values()], expected)
    lost = sum(said["lost"] for said in messages[1:])  # those of the first message lie before its ticks
    assert sum(said["ticks"] for said in messages) + lost == end - first
