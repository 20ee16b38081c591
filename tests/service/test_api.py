"""The control API of a real service on a board: what it does, what it refuses, and what the recording says of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from prometheus_client.parser import text_string_to_metric_families
from websockets.sync.client import unix_connect

import rtloop
from rtloop.cli import main
from tests.faults.account import account, runs_in
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.service.http import GOOD_CONTROLLER, answer


def events(bench: Bench, kind: str) -> list[dict[str, Any]]:
    """Of this kind, in the recording as far as it is written."""
    path = next((bench.folder / "recordings").glob("*.mcap.part"))
    return [event for event in rtloop.load(path).events if event["kind"] == kind]


def recorded(bench: Bench, kind: str, tick: int) -> dict[str, Any]:
    """The event of a change, once it is written."""
    found = wait_for(lambda: [e for e in events(bench, kind) if e["tick"] == tick], f"{kind} at {tick} in the file")
    assert found[0]["who"] == "operator"
    return found[0]


def test_states_and_refusals(bench: Bench):
    status = bench.client.get("/status")
    assert (status["state"], status["armed"], status["mode"], status["trip"]) == ("stopped", False, "off", [])
    written = status["recording"].pop("written_ticks")
    assert 0 <= written <= bench.ticks
    assert Path(status["recording"].pop("file")).parent == bench.folder / "recordings"
    assert status["recording"] == {"state": "recording", "reason": None, "since_tick": None, "ticks_lost": 0}
    for path, body in (("/start", {}), ("/mode", {"mode": "raw"})):
        code, said = answer(bench, "POST", path, body)
        assert code == 409
        assert "not armed" in said["error"]
    assert answer(bench, "POST", "/arm") == (200, {})
    assert bench.client.get("/status")["state"] == "armed"
    tick = bench.client.post("/start")["tick"]
    assert bench.client.get("/status")["state"] == "running"
    assert recorded(bench, "set_mode", tick)["what"]["mode"] == "closed_loop"
    tick = bench.client.post("/stop")["tick"]
    assert recorded(bench, "set_mode", tick)["what"]["mode"] == "off"
    bench.await_state("stopped")
    wait_for(lambda: bench.seen().last_v == 0.0, "a safe output")


def test_a_trip_latches_until_the_reset(running: Bench):
    tick = running.client.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 5.0}})["tick"]
    assert recorded(running, "load_law", tick)["axis"] == "x"
    running.await_state("tripped", "position")
    for path, body in (("/start", {}), ("/arm", {}), ("/mode", {"mode": "feedforward"}), ("/response", {"axis": "x"})):
        code, said = answer(running, "POST", path, body)
        assert (code, "`rtloop ctl reset`" in said["error"]) == (409, True), said
    for path, body in (("/stop", {}), ("/mode", {"mode": "off"}), ("/stop", {})):
        code, said = answer(running, "POST", path, body)
        assert code == 200, said
        assert tick < said["tick"] <= running.ticks
    assert answer(running, "GET", "/status")[1]["state"] == "tripped"
    running.client.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 60.0}})
    tick = running.client.post("/reset")["tick"]
    recorded(running, "reset_trip", tick)
    assert running.client.get("/status")["state"] in ("stopped", "ramping")
    assert answer(running, "POST", "/start")[0] == 409
    running.client.post("/arm")


def test_modes_and_references(running: Bench):
    for reference in ({"kind": "hold", "value": 12.0}, {"kind": "triangle", "amplitude": 3.0, "frequency_hz": 2.0},
                      {"kind": "steps", "levels": [1.0, 2.0], "dwell_s": 0.1}):  # fmt: skip
        tick = running.client.post("/reference", {"axis": "x", "reference": reference})["tick"]
        recorded(running, "set_reference", tick)
    running.client.post("/setpoint", {"axis": "x", "value": 11.0})
    assert running.client.get("/status")["axes"]["x"]["reference_um"] == 11.0
    running.client.post("/mode", {"mode": "feedforward"})
    assert running.client.get("/status")["mode"] == "feedforward"


def test_a_healthy_loop_is_not_reset(running: Bench):
    code, said = answer(running, "POST", "/reset")
    assert (code, "there is no trip; the state of the service is running" in said["error"]) == (409, True)
    assert running.client.get("/status")["mode"] == "closed_loop"


def test_into_raw_mode_and_out_of_it_what_is_in_force_is_held(running: Bench):
    """20 µm are not taken for 20 V, nor 3 V for 3 µm; as the recording has it."""
    running.client.post("/setpoint", {"axis": "x", "value": 20.0})
    settled = running.ticks + 4000
    wait_for(lambda: running.ticks > settled, "20 µm")
    raw_tick = running.client.post("/mode", {"mode": "raw"})["tick"]
    for volts, code in ((10.5, 422), (-10.5, 422), (6.0, 200)):
        code_, said = answer(running, "POST", "/setpoint", {"axis": "x", "value": volts})
        assert code_ == code
        assert code == 200 or "references in mode raw are in V" in said["error"]
    settled = running.ticks + 4000
    wait_for(lambda: running.ticks > settled, "6 V")
    closed_tick = running.client.post("/mode", {"mode": "closed_loop"})["tick"]
    wait_for(lambda: running.ticks > closed_tick + 4000, "the loop closed")
    running.client.post("/stop")
    recorded(running, "set_mode", closed_tick)
    recording = rtloop.load(next((running.folder / "recordings").glob("*.mcap.part")))
    first = int(recording["tick"][0])
    reference, position, drive = recording.read("x_reference_um", "x_position_um", "x_drive_v")
    raw, closed = raw_tick - first, closed_tick - first
    assert reference[raw - 1] == 20.0
    assert reference[raw] == drive[raw - 1]
    assert np.ptp(drive[raw - 1 : raw + 3]) < 1e-9
    assert reference[closed] == position[closed - 1]
    held = position[closed + 2000 : closed + 4000]
    assert abs(held.mean() - reference[closed]) < 0.1
    assert reference[closed] > 15.0  # µm, where 6 V have brought it


def test_a_waveform_plays_once(running: Bench):
    samples = (15.0 + 5.0 * np.sin(np.linspace(0.0, 2 * np.pi, 500))).tolist()
    tick = running.client.post("/waveform", {"axis": "x", "samples": samples, "hold_ticks": 2})["tick"]
    assert recorded(running, "set_reference", tick)["what"]["values"][2:5] == [500.0, 2.0, 0.0]
    wait_for(lambda: running.ticks > tick + 1100, "its end")
    assert running.client.get("/status")["axes"]["x"]["reference_um"] == samples[-1]


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


@pytest.mark.parametrize(("typed", "code"), [("-5", 0), ("-.5e1", 0), ("-50", 1), ("--nonsense", 2)])
def test_a_negative_number_is_no_option(running: Bench, typed: str, code: int):
    done = CliRunner().invoke(main, ["ctl", "--socket", str(running.client.path), "setpoint", "x", typed])
    assert done.exit_code == code, done.output
    if code == 0:
        assert running.client.get("/status")["axes"]["x"]["reference_um"] == -5.0


def test_watch_tells_the_newest_signals(bench: Bench):
    lines = iter(bench.client.watch())
    first, second = next(lines), next(lines)
    assert first["state"] == "stopped"
    assert second["tick"] > first["tick"]
    assert set(first["axes"]["x"]) >= {"position_um", "drive_v"}


def test_tune_and_swap(running: Bench):
    for path, body in (
        ("/tune", {"axis": "x", "section": "controller", "values": {"gain": 0.012}}),
        ("/tune", {"axis": "x", "section": "limits", "values": {"command_um": 40.0}}),
        ("/controller", {"axis": "x", "controller": GOOD_CONTROLLER}),
    ):
        tick = running.client.post(path, body)["tick"]
        assert recorded(running, "load_law", tick)["axis"] == "x"
    assert answer(running, "POST", "/setpoint", {"axis": "x", "value": 41.0})[0] == 422
    assert running.client.get("/status")["state"] == "running"
    running.client.post("/reload")  # back to the file
    assert answer(running, "POST", "/setpoint", {"axis": "x", "value": 20.0})[0] == 200


def test_reload(running: Bench):
    good = running.config.read_text()
    try:
        assert running.client.post("/reload") == {"changed": []}
        running.config.write_text(good.replace("offset = 20.0", "offset = 18.0\nphase_deg = 90.0"))
        assert running.client.post("/reload") == {"changed": ["axis.x"]}
        wait_for(lambda: [e for e in events(running, "set_reference") if e["what"]["values"][3] == 18.0], "a reference")
        for bad, code, word in (
            (good.replace("rate_hz = 4000", "rate_hz = 5000"), 409, "restart"),
            (good.replace("gain = 0.016", "gain = 0.16"), 422, "unstable"),
            (good + "[nonsense", 422, "TOML"),
        ):
            running.config.write_text(bad)
            assert answer(running, "POST", "/reload")[0] == code
            assert word in answer(running, "POST", "/reload")[1]["error"]
    finally:
        running.config.write_text(good)
    assert running.client.post("/reload") == {"changed": ["axis.x"]}


def test_metrics_and_description(bench: Bench):
    families = {family.name: family for family in text_string_to_metric_families(bench.client.get("/metrics"))}
    states = {sample.labels["state"]: sample.value for sample in families["rtloop_state"].samples}
    assert sum(states.values()) == 1.0
    assert states["stopped"] == 1.0
    assert families["rtloop_ticks"].samples[0].value > 0
    assert families["rtloop_recording"].samples[0].value == 1.0
    assert families["rtloop_ticks_not_recorded"].samples[0].value == 0.0
    assert 0 < families["rtloop_rate_hz"].samples[0].value < 4400.0  # of 4000; a host that stands still lowers it
    description = bench.client.get("/openapi.json")
    assert description["openapi"].startswith("3.1")
    assert {"/status", "/metrics", "/mode", "/tune", "/controller", "/waveform"} <= set(description["paths"])
    schema = description["paths"]["/tune"]["post"]["requestBody"]["content"]["application/json"]["schema"]
    assert schema["required"] == ["axis", "section", "values"]
    assert schema["additionalProperties"] is False


def test_the_end_is_whole_and_replays(bench: Bench):
    """Last in this file: the service that all tests shared ends, and everything is in its recording."""
    assert bench.stop() == 0
    found = account(bench.folder / "recordings", bench.blocks)
    assert found.problems == []
    assert found.lost == 0
    assert "Traceback" not in bench.log()
    assert len(runs_in(bench.folder / "recordings")) == 1
