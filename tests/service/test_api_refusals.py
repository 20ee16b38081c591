"""The control API refuses invalid and hostile requests with the right 4xx status, and changes nothing."""

from __future__ import annotations

import json
import os
from typing import Any

import pytest

from rtloop.engine.memory import Word
from tests.service.hostile import EXPENSIVE, HUGE, hostile_requests
from tests.service.http import GOOD_CONTROLLER
from tests.virtual.bench import VirtualBench


def commands_sent(bench: VirtualBench) -> int:
    """Return how many commands the loop has got."""
    assert bench.loop is not None
    return bench.loop.block.load(Word.COMMANDS_HEAD)


def exchange(bench: VirtualBench, method: str, resource: str, body: bytes) -> tuple[int, bytes]:
    """Return status and body of a request."""
    code, _, data = bench.client.exchange(method, resource, body)
    return code, data


@pytest.mark.parametrize(("path", "body"), [
    ("/setpoint", {"axis": "x", "value": 43.0}),
    ("/setpoint", {"axis": "y", "value": 1.0}),
    ("/setpoint", {"axis": "x", "value": "one"}),
    ("/setpoint", {"axis": "x"}),
    ("/setpoint", {"axis": "x", "value": float("nan")}),
    ("/waveform", {"axis": "x", "samples": [0.0, float("inf")]}),
    ("/reference", {"axis": "x", "reference": {"kind": "sine", "amplitude": 30.0, "frequency_hz": 1.0, "offset": 20}}),
    ("/reference", {"axis": "x", "reference": {"kind": "sine", "amplitude": 1.0, "frequency_hz": 3999.0}}),
    ("/reference", {"axis": "x", "reference": {"kind": "sawtooth"}}),
    ("/waveform", {"axis": "x", "samples": []}),
    ("/waveform", {"axis": "x", "samples": [99.0]}),
    ("/waveform", {"axis": "x", "samples": [0.0], "hold_ticks": 0}),
    ("/tune", {"axis": "x", "section": "limits", "values": {"drive_v": 12.0}}),
    ("/tune", {"axis": "x", "section": "limits", "values": {"drive": 9.0}}),
    ("/tune", {"axis": "x", "section": "feedforward", "values": {"dead_band": "exact"}}),
    ("/tune", {"axis": "x", "section": "controller", "values": {"gain": 0.16}}),
    ("/tune", {"axis": "x", "section": "controller", "values": {"gain": 1e308}}),
    ("/controller", {"axis": "x", "controller": GOOD_CONTROLLER | {"gain": 6e5}}),
    ("/controller", {"axis": "x", "controller": {"form": "nonsense"}}),
    ("/mode", {"mode": "fast"}),
    ("/mode", {"mode": "off", "more": 1}),
])  # fmt: skip
def test_what_is_outside_the_envelope_changes_nothing(virtual_bench: VirtualBench, path: str, body: dict[str, Any]):
    commands = commands_sent(virtual_bench)
    code, response = virtual_bench.answer("POST", path, body)
    assert code == 422, response
    assert response["error"][0].isalnum(), response  # the message begins with a key
    assert commands_sent(virtual_bench) == commands


@pytest.mark.parametrize(
    "data", [b"", b"{", b"[]", b"null", b"\xff\xfe", b'{"mode": NaN}', b"[" * 100_000, b'{"mode":']
)
def test_malformed_json(virtual_bench: VirtualBench, data: bytes):
    code, response = exchange(virtual_bench, "POST", "/mode", data)
    assert code == 422
    assert json.loads(response)["error"]


@pytest.mark.parametrize("kind", ["fifo", "zero", "shadow", "link", "above"])
def test_a_table_is_a_file_below_the_configuration(virtual_bench: VirtualBench, kind: str):
    """A client of the API must not read files outside the configuration's folder with the rights of the service."""
    folder = virtual_bench.folder
    name = {"zero": "/dev/zero", "shadow": "/etc/passwd", "above": f"../{folder.name}/wave.csv"}.get(kind, kind)
    (folder / "wave.csv").write_text("1.0\n")
    if kind == "fifo":
        os.mkfifo(folder / "fifo")
    if kind == "link":
        (folder / "link").symlink_to("/etc/passwd")
    code, response = virtual_bench.answer(
        "POST", "/reference", {"axis": "x", "reference": {"kind": "table", "file": name}}
    )
    assert code == 422
    assert "root" not in response["error"].replace(str(folder), "")


def test_a_table_below_the_configuration_plays(virtual_bench: VirtualBench):
    folder = virtual_bench.folder / "waves"
    folder.mkdir()
    (folder / "wave.csv").write_text("1.0\n2.0\n")
    body = {"axis": "x", "reference": {"kind": "table", "file": "waves/wave.csv", "hold_ticks": 3}}
    assert virtual_bench.answer("POST", "/reference", body)[0] == 200
    (folder / "wave.csv").write_text("root of all\n")
    code, response = virtual_bench.answer("POST", "/reference", body)
    assert (code, "root" in response["error"]) == (422, False)
    assert virtual_bench.answer("POST", "/setpoint", {"axis": "x", "value": 0.0})[0] == 200


def test_unknown_too_large_and_wrong_method(virtual_bench: VirtualBench):
    assert virtual_bench.answer("GET", "/nowhere")[0] == 404
    assert virtual_bench.answer("GET", "/mode")[0] == 405
    assert virtual_bench.answer("DELETE", "/status")[0] == 405
    code, response = exchange(virtual_bench, "POST", "/waveform", b" " * (5 << 20))
    assert code == 413
    assert "bytes" in json.loads(response)["error"]
    samples = [0.0] * 600_000
    code, response = virtual_bench.answer("POST", "/waveform", {"axis": "x", "samples": samples})
    assert code == 422
    assert "at most" in response["error"]


@pytest.mark.parametrize(("path", "body"), [
    ("/reference", {"axis": "x", "reference": {"kind": "steps", "levels": [1.0], "dwell_s": 1e308}}),
    ("/tune", {"axis": "x", "section": "controller", "values": {"prewarp_hz": 5e-324}}),
    ("/tune", {"axis": "x", "section": "interlocks", "values": {"swing_ticks": HUGE}}),
    ("/setpoint", {"axis": "x", "value": HUGE}),
    ("/waveform", {"axis": "x", "samples": [0.0], "hold_ticks": HUGE}),
    ("/controller", {"axis": "x", "controller": GOOD_CONTROLLER | {"gain": 10**4000}}),
    ("/controller", EXPENSIVE["/controller"]),
])  # fmt: skip
def test_numbers_that_nothing_can_be_made_of(virtual_bench: VirtualBench, path: str, body: dict[str, Any]):
    code, response = virtual_bench.answer("POST", path, body)
    assert code == 422, response
    assert 0 < len(response["error"]) < 2000


def test_hostile_requests_are_refused_and_change_nothing(virtual_bench: VirtualBench):
    refused = 0
    for path, body in hostile_requests(seed=1, count=120):
        commands = commands_sent(virtual_bench)
        code, response = exchange(virtual_bench, "POST", path, body)
        assert code in (200, 413, 422), (path, body[:300], response)
        if code != 200:
            refused += 1
            assert len(json.loads(response)["error"]) < 2000
            assert commands_sent(virtual_bench) == commands
    assert refused > 80
    virtual_bench.client.post("/reload")  # load the file again: some of the requests were accepted
