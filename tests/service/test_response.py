"""A running service measures its own loop: what it finds, what it refuses, and that it always comes back."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from click.testing import CliRunner
from prometheus_client.parser import text_string_to_metric_families

import rtloop
from rtloop.cli import main
from tests.design.measured_loops import RATE_HZ, TrueLoop, margins_of
from tests.faults.bench import Bench
from tests.faults.configuration import ROOT
from tests.faults.evidence import wait_for
from tests.service.http import answer

DASHBOARD = ROOT / "deploy" / "grafana" / "rtloop.json"
METRIC = re.compile(r"\brtloop_\w+")
LOOP = TrueLoop(800.0, 0.02, 1, 100.0, kp=0.01)
OMEGA = 2 * np.pi * LOOP.hz
HELD_UM = 5.0
QUICK = {"axis": "x", "duration_s": 1.0, "period_s": 0.25, "near_hz": 800.0}
CONFIGURATION = f"""
[loop]
rate_hz = {RATE_HZ:g}
[driver]
kind = "sim"
seed = 3
latency_ticks = {LOOP.delay_ticks}
[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 10.0
[driver.plant.hysteresis]
truth = "custom"
thresholds_v = [0.0]
weights_um_per_v = [4.3]
[driver.plant.dynamics]
form = "factors"
gain = {OMEGA**2!r}
denominator = [[1.0, {2 * LOOP.damping * OMEGA!r}, {OMEGA**2!r}]]
[[axis]]
name = "x"
[axis.feedforward]
thresholds_v = [0.0]
weights_um_per_v = [4.3]
[axis.controller]
kind = "pid"
kp = {LOOP.kp}
ki_per_s = {LOOP.ki_per_s}
[axis.interlocks]
position_um = 30.0
[axis.reference]
kind = "hold"
value = {HELD_UM}
[recording]
folder = "FOLDER/recordings"
"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    folder = tmp_path_factory.mktemp("response")
    with Bench(folder, board=False, text=CONFIGURATION.replace("FOLDER", str(folder))) as bench:
        bench.await_state("running")
        yield bench


def reference_um(bench: Bench) -> float:
    return bench.status()["axes"]["x"]["reference_um"]


def recording(bench: Bench) -> Path:
    return next((bench.folder / "recordings").glob("*.mcap.part"))


def written(bench: Bench, tick: int) -> rtloop.Recording:
    """The recording, once it holds this tick."""
    return wait_for(lambda: [one for one in [rtloop.load(recording(bench))] if one["tick"][-1] >= tick], "the ticks")[0]


class Shown(NamedTuple):
    text: str
    found: dict[str, Any]
    picture: bytes


def command(bench: Bench, *arguments: str | Path) -> str:
    """What a command says that ends well."""
    ran = CliRunner().invoke(main, [*map(str, arguments)])
    assert ran.exit_code == 0, ran.output
    return ran.output


@pytest.fixture(scope="module")
def shown(bench: Bench) -> Shown:
    """Of `rtloop ctl response`."""
    file, picture = bench.folder / "response.json", bench.folder / "response.png"
    quick = ("--duration", "1", "--period", "0.25", "--near-hz", "800", "--amplitude-um", "0.6")
    files = ("--plot", picture, "--out", file)
    text = command(bench, "ctl", "--socket", bench.client.path, "response", "x", *quick, *files)
    return Shown(text, json.loads(file.read_text()), picture.read_bytes())


def test_margins_and_motion_are_those_of_the_rig(bench: Bench, shown: Shown) -> None:
    found = shown.found
    true = margins_of(LOOP.open, found["from_hz"], found["to_hz"])
    for name in ("gain_margin", "phase_margin_deg", "modulus_margin"):
        margin = found["margins"][name]
        assert 0.0 < margin["std"] < 0.02 * true[name], margin
        error = abs(margin["value"] - true[name])
        assert error < 0.05 * true[name], margin
        assert error < 8.0 * margin["std"], margin  # of four periods: Student's t leaves 5 of them too often
    assert found["resonance"]["hz"] == pytest.approx(LOOP.hz, rel=0.002)
    assert found["model"] is None
    assert reference_um(bench) == HELD_UM
    position_um = written(bench, bench.status()["tick"])["x_true_position_um"]
    assert 0.1 < np.abs(position_um[round(0.5 * RATE_HZ) :] - HELD_UM).max() <= 0.6


def test_figures_are_told_and_the_recording_gives_the_same(bench: Bench, shown: Shown) -> None:
    found, told = shown.found, bench.status()["measured"]["x"]
    assert told["margins"] == found["margins"]
    mode = found["resonance"]
    assert told["resonance_trend"][-1] == [told["unix_time_s"], mode["hz"], mode["hz_std"]]
    samples = {
        (sample.name, *sample.labels.values()): sample.value
        for family in text_string_to_metric_families(bench.client.get("/metrics"))
        for sample in family.samples
    }
    assert samples["rtloop_margin", "x", "gain_margin"] == found["margins"]["gain_margin"]["value"]
    assert samples["rtloop_resonance_std", "x", "hz"] == mode["hz_std"]
    written(bench, bench.status()["tick"])
    again = command(bench, "identify", "response", recording(bench), "--near-hz", "800", "--json")
    assert json.loads(again) == found


def test_all_that_the_dashboard_asks_for_is_there(bench: Bench, shown: Shown) -> None:
    """`rtloop_trip` is there while one is in force alone."""
    served = {
        sample.name
        for family in text_string_to_metric_families(bench.client.get("/metrics"))
        for sample in family.samples
    }
    board = json.loads(DASHBOARD.read_text())
    asked = {name for panel in board["panels"] for one in panel["targets"] for name in METRIC.findall(one["expr"])}
    assert len(asked) > 20
    assert asked - served == {"rtloop_trip"}
    assert METRIC.findall(board["templating"]["list"][1]["query"]["query"]) == ["rtloop_ticks"]
    new = {"rtloop_error_square_um2_total", "rtloop_drive_square_v2_total", "rtloop_tick_lateness_seconds_bucket"}
    assert new <= asked
    assert not [name for name in served - asked if name.endswith("_total")]


def test_a_loop_that_runs_and_does_not_control_is_told(bench: Bench) -> None:
    """With 1 V, 4.3 µm is all that there is of the 5 µm asked for; noise alone is more than a tenth of a nanometre."""

    def tuned(**limits: float | None) -> None:
        bench.client.post("/tune", {"axis": "x", "section": "limits", "values": limits})

    def told() -> str:
        (family,) = (one for one in text_string_to_metric_families(bench.client.get("/metrics"))
                     if one.name == "rtloop_condition")  # fmt: skip
        (found,) = (sample.labels["condition"] for sample in family.samples if sample.value == 1.0)
        assert next(bench.client.watch())["condition"] == bench.status()["condition"] == {"x": found}
        return found

    wait_for(lambda: bench.status()["condition"] == {"x": "controlled"}, "a loop that controls")
    tuned(drive_v=1.0)
    wait_for(lambda: bench.status()["condition"] != {"x": "controlled"}, "another condition")
    assert told() == "saturated"
    tuned(drive_v=10.0, settled_within_um=1e-4)
    wait_for(lambda: bench.status()["condition"] == {"x": "not settled"}, "another condition")
    assert told() == "not settled"
    assert bench.status()["state"] == "running"
    tuned(settled_within_um=None)
    wait_for(lambda: bench.status()["condition"] == {"x": "controlled"}, "a loop that controls")


@pytest.mark.skipif(shutil.which("curl") is None, reason="there is no curl")
def test_the_metrics_get_to_where_prometheus_looks(bench: Bench, tmp_path: Path) -> None:
    """By the script in deploy/grafana, each with the name of the service; and nothing stays of one that is gone."""
    script, environment = DASHBOARD.with_name("scrape"), bench.environment
    subprocess.run([script, "lab", tmp_path], env=environment, check=True)
    families = [*text_string_to_metric_families((tmp_path / "rtloop-lab.prom").read_text())]
    assert {sample.labels["service"] for family in families for sample in family.samples} == {"lab"}
    assert {family.name for family in families} >= {
        "rtloop_ticks",
        "rtloop_error_square_um2",
        "rtloop_tick_lateness_seconds",
    }
    elsewhere = environment | {"RUNTIME_DIRECTORY": str(tmp_path)}
    assert subprocess.run([script, "lab", tmp_path], env=elsewhere, stderr=subprocess.DEVNULL).returncode == 1
    assert not [*tmp_path.iterdir()]


def test_sums_are_those_of_the_recording(bench: Bench) -> None:
    sums = {
        sample.name: sample.value
        for family in text_string_to_metric_families(bench.client.get("/metrics"))
        for sample in family.samples
        if sample.name.endswith("_total")
    }
    ticks = int(sums["rtloop_ticks_summed_total"])
    errors = written(bench, ticks)["x_error_um"][:ticks]
    closed = written(bench, ticks)["mode"][:ticks] == 3
    assert ticks > RATE_HZ
    assert sums["rtloop_closed_loop_ticks_total"] == np.count_nonzero(closed)
    assert sums["rtloop_error_square_um2_total"] == pytest.approx(np.sum(errors[closed] ** 2), rel=1e-9)


def test_it_is_shown(shown: Shown) -> None:
    for word in ("gain margin", "phase margin", "modulus margin", "resonance", "moved by"):
        assert word in shown.text
    assert shown.picture.startswith(b"\x89PNG")


def test_the_gain_at_rest_is_measured_and_told(bench: Bench) -> None:
    """The rig's is 1: its actuator is that of the inverse, and D(0) = 1."""
    asked = {"axis": "x", "duration_s": 1.0, "resonance_only": True, "near_hz": 800.0, "gain_um": 4.0}
    gain = bench.client.post("/response", asked, 60.0)["gain"]
    assert (gain["from_um"], gain["to_um"]) == (HELD_UM, HELD_UM - 4.0)
    assert 0.0 < gain["std"] < 0.002
    assert abs(gain["value"] - 1.0) < 4.0 * gain["std"]
    assert bench.status()["measured"]["x"]["gain"] == gain
    assert f'rtloop_gain{{axis="x"}} {gain["value"]!r}' in bench.client.get("/metrics")
    assert reference_um(bench) == HELD_UM


def test_a_resonance_alone_is_measured_as_well(bench: Bench) -> None:
    quick = ("--duration", "1", "--near-hz", "780", "--json")
    found = json.loads(command(bench, "ctl", "--socket", bench.client.path, "resonance", "x", *quick))
    assert found["resonance"]["hz"] == pytest.approx(LOOP.hz, rel=0.0006)
    assert found["resonance"]["damping"] == pytest.approx(LOOP.damping, rel=0.05)


@pytest.mark.parametrize(
    ("change", "code", "said"),
    [
        ({"axis": "z"}, 422, "allowed: x"),
        ({"amplitude_um": 0.0}, 422, "amplitude_um"),
        ({"amplitude_um": float("nan")}, 422, "amplitude_um"),
        (
            {"amplitude_um": 26.0},
            422,
            "5 µm; allowed: up to 25 µm, the distance to ±30 µm, where axis.x.interlocks.position_um trips",
        ),
        ({"from_hz": 300.0, "to_hz": 200.0}, 422, "0 < from_hz < to_hz"),
        ({"to_hz": 4999.0}, 422, "to_hz ≤ 4500 Hz"),
        ({"duration_s": 1000.0}, 422, "duration_s"),
        ({"gain_um": -1.0}, 422, "gain_um"),
        ({"near_hz": None, "resonance_only": True}, 422, "near_hz: missing"),
    ],
)
def test_what_makes_no_sense_is_refused(bench: Bench, change: dict[str, Any], code: int, said: str) -> None:
    found, text = answer(bench, "POST", "/response", {**QUICK, **change})
    assert (found, said in text["error"]) == (code, True), text
    assert reference_um(bench) == HELD_UM


def test_only_a_held_reference_in_closed_loop_is_measured(bench: Bench) -> None:
    wave = {"kind": "sine", "amplitude": 1.0, "frequency_hz": 1.0}
    bench.client.post("/reference", {"axis": "x", "reference": wave})
    code, text = answer(bench, "POST", "/response", QUICK)
    assert (code, "kind is sine; allowed: hold" in text["error"]) == (409, True), text
    bench.client.post("/setpoint", {"axis": "x", "value": HELD_UM})
    bench.client.post("/mode", {"mode": "feedforward"})
    code, text = answer(bench, "POST", "/response", QUICK)
    assert (code, "the mode is not closed_loop" in text["error"]) == (409, True), text
    bench.client.post("/mode", {"mode": "closed_loop"})
    bench.client.post("/stop")
    code, text = answer(bench, "POST", "/response", QUICK)
    assert (code, "needs a running loop" in text["error"]) == (409, True), text
    bench.client.post("/start")
    bench.await_state("running")


def test_out_of_raw_mode_the_measurement_is_about_the_position_that_is_held(bench: Bench) -> None:
    """And not about the volts: 1 V is 4.3 µm."""
    bench.client.post("/mode", {"mode": "raw"})
    code, text = answer(bench, "POST", "/response", QUICK)
    assert (code, "the mode is not closed_loop" in text["error"]) == (409, True), text
    bench.client.post("/setpoint", {"axis": "x", "value": 1.0})
    tick = bench.ticks
    wait_for(lambda: bench.ticks > tick + RATE_HZ // 5, "a position at rest")
    bench.client.post("/mode", {"mode": "closed_loop"})
    held_um = reference_um(bench)
    assert held_um == pytest.approx(4.3, abs=0.5)
    code, found = answer(bench, "POST", "/response", QUICK)
    assert code == 200, found
    assert reference_um(bench) == held_um
    bench.client.post("/setpoint", {"axis": "x", "value": HELD_UM})


def test_whoever_sets_a_reference_meanwhile_ends_the_measurement(bench: Bench) -> None:
    """As Ctrl-C does, with what was held."""
    answers: list[tuple[int, Any]] = []
    asking = threading.Thread(target=lambda: answers.append(answer(bench, "POST", "/response", QUICK)))
    asking.start()
    wait_for(lambda: reference_um(bench) != HELD_UM, "an excitation")
    assert answer(bench, "POST", "/response", QUICK)[0] == 503
    bench.client.post("/setpoint", {"axis": "x", "value": 4.0})
    asking.join()
    ((code, text),) = answers
    assert (code, "another client has set a reference" in text["error"]) == (409, True), text
    assert reference_um(bench) == 4.0
    bench.client.post("/setpoint", {"axis": "x", "value": HELD_UM})


def test_after_ctrl_c_what_was_held_is_held_again(bench: Bench) -> None:
    command = [
        sys.executable,
        "-m",
        "rtloop",
        "ctl",
        "--socket",
        bench.client.path,
        "response",
        "x",
        "--duration",
        "30",
    ]
    asking = subprocess.Popen(command, env=bench.environment, stderr=subprocess.PIPE, text=True)
    wait_for(lambda: reference_um(bench) != HELD_UM, "an excitation")
    asking.send_signal(signal.SIGINT)
    _, said = asking.communicate(timeout=60)
    assert (asking.returncode, "holds 5 µm as before" in said) == (1, True), said
    assert reference_um(bench) == HELD_UM


def test_a_loop_that_trips_is_left_to_its_interlocks(bench: Bench) -> None:
    asking: list[tuple[int, Any]] = []
    thread = threading.Thread(target=lambda: asking.append(answer(bench, "POST", "/response", QUICK)))
    thread.start()
    wait_for(lambda: reference_um(bench) != HELD_UM, "an excitation")
    bench.client.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 3.0}})
    thread.join()
    ((code, text),) = asking
    assert (code, "the loop tripped (position" in text["error"]) == (409, True), text
    bench.client.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 30.0}})
    bench.client.post("/reset")
    bench.client.post("/start")
    bench.await_state("running")


def test_a_service_that_ends_says_so_to_who_still_measures(bench: Bench) -> None:
    """Last in this file."""
    asking: list[tuple[int, Any]] = []
    thread = threading.Thread(target=lambda: asking.append(answer(bench, "POST", "/response", QUICK)))
    thread.start()
    wait_for(lambda: reference_um(bench) != HELD_UM, "an excitation")
    assert bench.stop() == 0
    thread.join()
    assert asking == [(503, {"error": "response: the service is ending and takes no more requests"})]
    assert "Traceback" not in bench.log()
