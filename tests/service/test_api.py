"""The control API of a real service on a board: states, references and changes. The recording is the evidence."""

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
from tests.command_line import run
from tests.faults.account import account, runs_in
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.service.http import GOOD_CONTROLLER, answer


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


def test_a_trip_latches_until_the_reset(running: Bench):
    tick = running.client.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 5.0}})["tick"]
    assert await_event(running, "load_law", tick)["axis"] == "x"
    running.await_state("tripped", "position")
    for path, body in (("/start", {}), ("/arm", {}), ("/mode", {"mode": "feedforward"}), ("/response", {"axis": "x"})):
        code, response = answer(running, "POST", path, body)
        assert (code, "`rtloop ctl reset`" in response["error"]) == (409, True), response
    for path, body in (("/stop", {}), ("/mode", {"mode": "off"}), ("/stop", {})):
        code, response = answer(running, "POST", path, body)
        assert code == 200, response
        assert tick < response["tick"] <= running.ticks
    assert answer(running, "GET", "/status")[1]["state"] == "tripped"
    running.client.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 60.0}})
    tick = running.client.post("/reset")["tick"]
    await_event(running, "reset_trip", tick)
    assert running.client.get("/status")["state"] in ("stopped", "ramping")
    assert answer(running, "POST", "/start")[0] == 409
    running.client.post("/arm")


def test_modes_and_references(running: Bench):
    for reference in ({"kind": "hold", "value": 12.0}, {"kind": "triangle", "amplitude": 3.0, "frequency_hz": 2.0},
                      {"kind": "steps", "levels": [1.0, 2.0], "dwell_s": 0.1}):  # fmt: skip
        tick = running.client.post("/reference", {"axis": "x", "reference": reference})["tick"]
        await_event(running, "set_reference", tick)
    running.client.post("/setpoint", {"axis": "x", "value": 11.0})
    assert running.client.get("/status")["axes"]["x"]["reference_um"] == 11.0
    running.client.post("/mode", {"mode": "feedforward"})
    assert running.client.get("/status")["mode"] == "feedforward"


def test_a_healthy_loop_is_not_reset(running: Bench):
    code, response = answer(running, "POST", "/reset")
    assert (code, "there is no trip; the state of the service is running" in response["error"]) == (409, True)
    assert running.client.get("/status")["mode"] == "closed_loop"


def test_into_raw_mode_and_out_of_it_what_is_in_force_is_held(running: Bench):
    """A change of mode does not reuse 20 µm as 20 V, nor 6 V as 6 µm; the recording shows the signals."""
    running.client.post("/setpoint", {"axis": "x", "value": 20.0})
    settled = running.ticks + 4000
    wait_for(lambda: running.ticks > settled, "20 µm")
    raw_tick = running.client.post("/mode", {"mode": "raw"})["tick"]
    for volts, expected_code in ((10.5, 422), (-10.5, 422), (6.0, 200)):
        code, response = answer(running, "POST", "/setpoint", {"axis": "x", "value": volts})
        assert code == expected_code
        assert code == 200 or "references in mode raw are in V" in response["error"]
    settled = running.ticks + 4000
    wait_for(lambda: running.ticks > settled, "6 V")
    closed_tick = running.client.post("/mode", {"mode": "closed_loop"})["tick"]
    wait_for(lambda: running.ticks > closed_tick + 4000, "the loop closed")
    running.client.post("/stop")
    await_event(running, "set_mode", closed_tick)
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
    assert reference[closed] > 15.0  # µm, the position that 6 V have reached


def test_a_waveform_plays_once(running: Bench):
    samples = (15.0 + 5.0 * np.sin(np.linspace(0.0, 2 * np.pi, 500))).tolist()
    tick = running.client.post("/waveform", {"axis": "x", "samples": samples, "hold_ticks": 2})["tick"]
    assert await_event(running, "set_reference", tick)["what"]["values"][2:5] == [500.0, 2.0, 0.0]
    wait_for(lambda: running.ticks > tick + 1100, "the end of the waveform")
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
    result = CliRunner().invoke(main, ["ctl", "--socket", str(running.client.path), "setpoint", "x", typed])
    assert result.exit_code == code, result.output
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
        assert await_event(running, "load_law", tick)["axis"] == "x"
    assert answer(running, "POST", "/setpoint", {"axis": "x", "value": 41.0})[0] == 422
    assert running.client.get("/status")["state"] == "running"
    running.client.post("/reload")  # load the file again
    assert answer(running, "POST", "/setpoint", {"axis": "x", "value": 20.0})[0] == 200


def test_reload(running: Bench):
    valid_text = running.config.read_text()
    try:
        assert running.client.post("/reload") == {"changed": []}
        running.config.write_text(valid_text.replace("offset = 20.0", "offset = 18.0\nphase_deg = 90.0"))
        assert running.client.post("/reload") == {"changed": ["axis.x"]}
        wait_for(lambda: [e for e in events(running, "set_reference") if e["what"]["values"][3] == 18.0], "a reference")
        for text, code, word in (
            (valid_text.replace("rate_hz = 4000", "rate_hz = 5000"), 409, "restart"),
            (valid_text.replace("gain = 0.016", "gain = 0.16"), 422, "unstable"),
            (valid_text + "[nonsense", 422, "TOML"),
        ):
            running.config.write_text(text)
            assert answer(running, "POST", "/reload")[0] == code
            assert word in answer(running, "POST", "/reload")[1]["error"]
    finally:
        running.config.write_text(valid_text)
    assert running.client.post("/reload") == {"changed": ["axis.x"]}


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


def test_the_end_is_whole_and_replays(bench: Bench):
    """End the shared service: all its ticks are in its recording. This test must be the last of the file."""
    assert bench.stop() == 0
    result = account(bench.folder / "recordings", bench.blocks)
    assert result.problems == []
    assert result.lost == 0
    assert "Traceback" not in bench.log()
    assert len(runs_in(bench.folder / "recordings")) == 1
