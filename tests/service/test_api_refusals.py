"""The control API refuses invalid and hostile requests with the right 4xx status, and changes nothing."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
from typing import Any

import pytest

from rtloop.engine.memory import Word
from rtloop.service.api.connections import BACKLOG, MAX_CONNECTIONS
from tests.faults.bench import Bench
from tests.service.hostile import EXPENSIVE, HUGE, hostile_requests
from tests.service.http import GOOD_CONTROLLER, answer, exchange


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
def test_what_is_outside_the_envelope_changes_nothing(bench: Bench, path: str, body: dict[str, Any]):
    commands = bench.blocks[-1].load(Word.COMMANDS_HEAD)
    code, response = answer(bench, "POST", path, body)
    assert code == 422, response
    assert response["error"][0].isalnum(), response  # the message begins with a key
    assert bench.blocks[-1].load(Word.COMMANDS_HEAD) == commands


@pytest.mark.parametrize(
    "data", [b"", b"{", b"[]", b"null", b"\xff\xfe", b'{"mode": NaN}', b"[" * 100_000, b'{"mode":']
)
def test_malformed_json(bench: Bench, data: bytes):
    code, response = exchange(bench.client.path, "POST", "/mode", data)
    assert code == 422
    assert json.loads(response)["error"]


@pytest.mark.parametrize("kind", ["fifo", "zero", "shadow", "link", "above"])
def test_a_table_is_a_file_below_the_configuration(bench: Bench, kind: str):
    """A client of the API must not read files outside the configuration's folder with the rights of the service."""
    folder = bench.config.parent
    name = {"zero": "/dev/zero", "shadow": "/etc/passwd", "above": f"../{folder.name}/wave.csv"}.get(kind, kind)
    (folder / "wave.csv").write_text("1.0\n")
    if kind == "fifo":
        os.mkfifo(folder / "fifo")
    if kind == "link":
        (folder / "link").symlink_to("/etc/passwd")
    code, response = answer(bench, "POST", "/reference", {"axis": "x", "reference": {"kind": "table", "file": name}})
    assert code == 422
    assert "root" not in response["error"].replace(str(folder), "")


def test_a_table_below_the_configuration_plays(bench: Bench):
    folder = bench.config.parent / "waves"
    folder.mkdir()
    (folder / "wave.csv").write_text("1.0\n2.0\n")
    body = {"axis": "x", "reference": {"kind": "table", "file": "waves/wave.csv", "hold_ticks": 3}}
    assert answer(bench, "POST", "/reference", body)[0] == 200
    (folder / "wave.csv").write_text("root of all\n")
    code, response = answer(bench, "POST", "/reference", body)
    assert (code, "root" in response["error"]) == (422, False)
    assert answer(bench, "POST", "/setpoint", {"axis": "x", "value": 0.0})[0] == 200


def test_unknown_too_large_and_wrong_method(bench: Bench):
    assert answer(bench, "GET", "/nowhere")[0] == 404
    assert answer(bench, "GET", "/mode")[0] == 405
    assert answer(bench, "DELETE", "/status")[0] == 405
    code, response = exchange(bench.client.path, "POST", "/waveform", b" " * (5 << 20))
    assert code == 413
    assert "bytes" in json.loads(response)["error"]
    samples = [0.0] * 600_000
    code, response = answer(bench, "POST", "/waveform", {"axis": "x", "samples": samples})
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
def test_numbers_that_nothing_can_be_made_of(bench: Bench, path: str, body: dict[str, Any]):
    code, response = answer(bench, "POST", path, body)
    assert code == 422, response
    assert 0 < len(response["error"]) < 2000


def test_hostile_requests_are_refused_and_change_nothing(bench: Bench):
    refused = 0
    for path, body in hostile_requests(seed=1, count=120):
        commands = bench.blocks[-1].load(Word.COMMANDS_HEAD)
        code, response = exchange(bench.client.path, "POST", path, body)
        assert code in (200, 413, 422), (path, body[:300], response)
        if code != 200:
            refused += 1
            assert len(json.loads(response)["error"]) < 2000
            assert bench.blocks[-1].load(Word.COMMANDS_HEAD) == commands
    assert refused > 80
    assert "Traceback" not in bench.log()
    bench.client.post("/reload")  # load the file again: some of the requests were accepted


def test_more_silent_clients_than_there_are_connections(bench: Bench):
    """No silent client sends a complete request, and half of them send nothing; the service answers another client."""
    with contextlib.ExitStack() as stack:
        for number in range(3 * MAX_CONNECTIONS):
            client = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
            client.connect(str(bench.client.path))
            if number % 2:
                with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                    client.send(b"POST /mode HTTP/1.1\r\nContent-Length: 100\r\n\r\n{")
        open_files = len(os.listdir(f"/proc/{bench.pid('service')}/fd"))
        assert open_files < MAX_CONNECTIONS + 3 * BACKLOG  # one backlog is being accepted, another being closed
        assert bench.client.get("/status")["state"] == "stopped"
        bench.client.post("/stop")


def test_the_socket_is_for_owner_and_group(bench: Bench):
    mode = os.stat(bench.client.path).st_mode
    assert stat.S_ISSOCK(mode)
    assert stat.S_IMODE(mode) == 0o660


def test_a_client_that_says_nothing_hinders_nobody(bench: Bench):
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as silent:
        silent.connect(str(bench.client.path))
        silent.send(b"POST /mode HTTP/1.1\r\nContent-Length: 100\r\n\r\n{")
        assert bench.client.get("/status")["state"] == "stopped"
