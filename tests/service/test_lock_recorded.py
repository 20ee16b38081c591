"""The lock of a service as its recording, its log, its streams and its next recorder know it."""

from __future__ import annotations

import hashlib
import json
import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest
from click.testing import CliRunner
from websockets.sync.client import unix_connect

import rtloop
from rtloop.cli import main
from rtloop.client import Client
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for

pytestmark = pytest.mark.system

KEY = "brass-otter-seven"
DIGEST = hashlib.sha256(KEY.encode()).hexdigest()
TUNE = {"axis": "x", "section": "limits", "values": {"bump_s": 0.02}}
ADA_HOLDS_LOCK = "ada has held the lock since "
REQUESTS: dict[str, Any] = {
    "/arm": {}, "/start": {}, "/reset": {}, "/reload": {}, "/mode": {"mode": "raw"}, "/tune": TUNE,
    "/setpoint": {"axis": "x", "value": 1.0}, "/reference": {"axis": "x", "reference": {"kind": "hold", "value": 1.0}},
    "/waveform": {"axis": "x", "samples": [1.0]}, "/response": {"axis": "x"},
    "/learn": {"axis": "x", "samples": [0.0] * 4}, "/controller": {"axis": "x", "controller": {}},
}  # fmt: skip
INVALID_NAMES = ["", " ada", "ada ", "a\nb", "\x1b[2Jada", "a\0b", "\u202eada", "[red]", "<b>", "a/b", "é" * 41,
                 "can", "LOOP", "recorder", "Operator", "42", "-rf", "\ufffd"]  # fmt: skip

VALID_NAMES = ["ada", "Ada Lovelace", "李小龍", "Zoë Ångström", "x.y-z_1", "a@b+c", "O'Neill"]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Yield a service on a board, armed on command, with an emergency key."""
    section = f'[service]\narm = true\nemergency_key_sha256 = "{DIGEST}"\n[recording]'
    with Bench(tmp_path_factory.mktemp("lock"), ("[recording]", section)) as bench:
        yield bench


def requester(bench: Bench, kind: str, tick: int) -> str:
    """Return the name of the client whose command took effect at `tick`, as soon as the recording has its event."""

    return requesters(bench, kind, [tick])[0]


def requesters(bench: Bench, kind: str, ticks: list[int]) -> list[str]:
    """Return the name of the client for each of `ticks`, as soon as the recording has all their events."""

    def read_names() -> list[str]:
        events = [event for part in (bench.folder / "recordings").glob("*.part") for event in rtloop.load(part).events]
        names = {event["tick"]: event["who"] for event in reversed(events) if event["kind"] == kind}
        return [names[tick] for tick in ticks] if names.keys() >= set(ticks) else []

    return wait_for(read_names, f"{kind} at {ticks} in the file")


def test_two_clients_drive_in_turn_and_the_stream_and_the_watch_know_the_holder(bench: Bench):
    ada, bob = (Client(bench.client.path, name) for name in ("ada", "bob"))
    ada.post("/arm")
    started = ada.post("/start")["tick"]
    bench.await_drive()
    with unix_connect(str(bench.client.path), "ws://localhost/setpoints?as=bob") as stream:
        stream.send(json.dumps({"axis": "x", "value": 1.0}))
        assert json.loads(stream.recv())["error"].startswith(ADA_HOLDS_LOCK)
    assert next(iter(bob.watch()))["lock"]["name"] == "ada"
    stopped, unnamed = bob.post("/stop")["tick"], bench.client.post("/stop")["tick"]
    assert requesters(bench, "set_mode", [started, stopped, unnamed]) == ["ada", "bob", "operator"]
    assert bob.lock(KEY)["name"] == "bob"
    wait_for(lambda: "bob takes the lock from ada" in bench.log(), "the line in the log")  # a thread writes it
    assert KEY not in bench.log()
    bob.delete("/lock")


def test_a_recorder_in_the_place_of_a_dead_one_knows_the_names(bench: Bench):
    dead = bench.pid("recorder")
    os.kill(dead, signal.SIGKILL)
    wait_for(lambda: bench.pid("recorder") != dead, "another recorder")
    with rtloop.connect(bench.client.path, as_="ada") as loop:
        assert requester(bench, "set_reference", loop.setpoint("x", 2.0)) == "ada"


def test_the_recording_shows_and_replays_it(bench: Bench):
    """End the shared service. This test must be the last of the file."""
    bench.client.post("/stop")
    assert bench.stop() == 0
    pattern = str(bench.folder / "recordings" / "lab*.mcap")
    info = CliRunner().invoke(main, ["info", pattern, "--json"])
    assert {"ada", "bob", "operator"} <= set(json.loads(info.output)["commands"])
    result = CliRunner().invoke(main, ["replay", pattern, "--json"])
    assert (result.exit_code, json.loads(result.output)["identical"]) == (0, True)
    assert "Traceback" not in bench.log()
