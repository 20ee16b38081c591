"""The control API of a real service on a board: states, references and changes. The recording is the evidence."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from websockets.sync.client import unix_connect

import rtloop
from rtloop.service.api.connections import BACKLOG, MAX_CONNECTIONS
from tests.command_line import run
from tests.faults.account import account, runs_in
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.service.http import answer

pytestmark = pytest.mark.system


def events(bench: Bench, kind: str) -> list[dict[str, Any]]:
    """Return the events of a kind that the unfinished recording contains so far."""
    path = next((bench.folder / "recordings").glob("*.mcap.part"))
    return [event for event in rtloop.load(path).events if event["kind"] == kind]


def await_event(bench: Bench, kind: str, tick: int) -> dict[str, Any]:
    """Wait until the recording has the event of an operator's change at `tick`, and return the event."""
    matches = wait_for(lambda: [e for e in events(bench, kind) if e["tick"] == tick], f"{kind} at {tick} in the file")
    assert matches[0]["who"] == "operator"
    return matches[0]


def test_states_and_refusals(bench: Bench):
    status = bench.client.get("/status")
    assert (status["state"], status["armed"], status["mode"], status["trip"]) == ("stopped", False, "off", [])
    written = status["recording"].pop("written_ticks")
    assert 0 <= written <= bench.ticks
    assert Path(status["recording"].pop("file")).parent == bench.folder / "recordings"
    assert status["recording"] == {"state": "recording", "reason": None, "since_tick": None, "ticks_lost": 0}
    for path, body in (("/start", {}), ("/mode", {"mode": "raw"})):
        code, response = answer(bench, "POST", path, body)
        assert code == 409
        assert "not armed" in response["error"]
    assert answer(bench, "POST", "/arm") == (200, {})
    assert bench.client.get("/status")["state"] == "armed"
    tick = bench.client.post("/start")["tick"]
    assert bench.client.get("/status")["state"] == "running"
    assert await_event(bench, "set_mode", tick)["what"]["mode"] == "closed_loop"
    tick = bench.client.post("/stop")["tick"]
    assert await_event(bench, "set_mode", tick)["what"]["mode"] == "off"
    bench.await_state("stopped")
    wait_for(lambda: bench.output_record().last_v == 0.0, "a safe output")


def test_setpoints_are_streamed(running: Bench):
    with unix_connect(str(running.client.path), "ws://localhost/setpoints") as stream:
        ticks = []
        for value in np.linspace(10.0, 12.0, 20):
            stream.send(json.dumps({"axis": "x", "value": value}))
            ticks.append(json.loads(stream.recv())["tick"])
        stream.send("nonsense")
        assert "error" in json.loads(stream.recv())
        stream.send(json.dumps({"axis": "x", "value": 99.0}))
        assert "a magnitude of 99 µm; allowed" in json.loads(stream.recv())["error"]
    assert ticks == sorted(set(ticks))
    assert running.client.get("/status")["axes"]["x"]["reference_um"] == 12.0
    assert "Traceback" not in running.log()


def test_watch_tells_the_newest_signals(bench: Bench):
    lines = iter(bench.client.watch())
    first, second = next(lines), next(lines)
    assert first["state"] == "stopped"
    assert second["tick"] > first["tick"]
    assert set(first["axes"]["x"]) >= {"position_um", "drive_v"}


def test_metrics_and_description(bench: Bench):
    families = {family.name: family for family in text_string_to_metric_families(bench.client.get("/metrics"))}
    states = {sample.labels["state"]: sample.value for sample in families["rtloop_state"].samples}
    assert sum(states.values()) == 1.0
    assert states["stopped"] == 1.0
    assert families["rtloop_ticks"].samples[0].value > 0
    assert families["rtloop_recording"].samples[0].value == 1.0
    assert families["rtloop_ticks_not_recorded"].samples[0].value == 0.0
    assert 0 < families["rtloop_rate_hz"].samples[0].value < 4400.0  # nominally 4000 Hz; a stall of the host lowers it
    description = bench.client.get("/openapi.json")
    assert description["openapi"].startswith("3.1")
    assert {"/status", "/metrics", "/mode", "/tune", "/controller", "/waveform"} <= set(description["paths"])
    schema = description["paths"]["/tune"]["post"]["requestBody"]["content"]["application/json"]["schema"]
    assert schema["required"] == ["axis", "section", "values"]
    assert schema["additionalProperties"] is False


def test_watch_prints_as_many_lines_as_asked(running: Bench):
    result = run("ctl", "--socket", running.client.path, "watch", "--count", 3)
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert [line["state"] for line in lines] == ["running"] * 3
    ticks = [line["tick"] for line in lines]
    assert ticks == sorted(set(ticks))


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


def test_the_end_is_whole_and_replays(bench: Bench):
    """End the shared service: all its ticks are in its recording. This test must be the last of the file."""
    assert bench.stop() == 0
    result = account(bench.folder / "recordings", bench.blocks)
    assert result.problems == []
    assert result.lost == 0
    assert "Traceback" not in bench.log()
    assert len(runs_in(bench.folder / "recordings")) == 1
