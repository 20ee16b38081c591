"""A measurement by `rtloop ctl` on a real service: its recording, its metrics, Ctrl-C, and the service's end."""

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
from tests.faults.bench import Bench
from tests.faults.configuration import ROOT
from tests.faults.evidence import wait_for
from tests.service.http import answer
from tests.service.test_response import CONFIGURATION, QUICK_REQUEST, RATE_HZ, SETPOINT_UM

pytestmark = pytest.mark.system

METRIC = re.compile(r"\brtloop_\w+")
DASHBOARD = ROOT / "deploy" / "grafana" / "rtloop.json"


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Yield a service whose loop runs on the rig of LOOP."""
    folder = tmp_path_factory.mktemp("response")
    with Bench(folder, board=False, text=CONFIGURATION.replace("FOLDER", str(folder))) as bench:
        bench.await_state("running")
        yield bench


def reference_um(bench: Bench) -> float:
    """Return the present reference (µm) of axis x."""
    return bench.status()["axes"]["x"]["reference_um"]


def recording_path(bench: Bench) -> Path:
    """Return the path of the unfinished recording."""
    return next((bench.folder / "recordings").glob("*.mcap.part"))


def await_recording(bench: Bench, tick: int) -> rtloop.Recording:
    """Wait until the recording holds a tick, and return the recording."""
    return wait_for(
        lambda: [file for file in [rtloop.load(recording_path(bench))] if file["tick"][-1] >= tick], "the ticks"
    )[0]


class CommandResult(NamedTuple):
    """Output, content of the result file, and PNG of `rtloop ctl response`."""

    text: str
    measurement: dict[str, Any]
    picture: bytes


def run_command(bench: Bench, *arguments: str | Path) -> str:
    """Run an rtloop command, check that it succeeds, and return its output."""
    result = CliRunner().invoke(main, [*map(str, arguments)])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module")
def command_result(bench: Bench) -> CommandResult:
    """Return the results of `rtloop ctl response` with a plot and a result file."""
    file, picture = bench.folder / "response.json", bench.folder / "response.png"
    quick = ("--duration", "1", "--period", "0.25", "--near-hz", "800", "--amplitude-um", "0.6")
    files = ("--plot", picture, "--out", file)
    text = run_command(bench, "ctl", "--socket", bench.client.path, "response", "x", *quick, *files)
    return CommandResult(text, json.loads(file.read_text()), picture.read_bytes())


def test_figures_are_told_and_the_recording_gives_the_same(bench: Bench, command_result: CommandResult) -> None:
    measurement, status = command_result.measurement, bench.status()["measured"]["x"]
    assert status["margins"] == measurement["margins"]
    mode = measurement["resonance"]
    assert status["resonance_trend"][-1] == [status["unix_time_s"], mode["hz"], mode["hz_std"]]
    samples = {
        (sample.name, *sample.labels.values()): sample.value
        for family in text_string_to_metric_families(bench.client.get("/metrics"))
        for sample in family.samples
    }
    assert samples["rtloop_margin", "x", "gain_margin"] == measurement["margins"]["gain_margin"]["value"]
    assert samples["rtloop_resonance_std", "x", "hz"] == mode["hz_std"]
    await_recording(bench, bench.status()["tick"])
    output = run_command(bench, "identify", "response", recording_path(bench), "--near-hz", "800", "--json")
    assert json.loads(output) == measurement


@pytest.mark.skipif(shutil.which("curl") is None, reason="there is no curl")
def test_the_metrics_get_to_where_prometheus_looks(bench: Bench, tmp_path: Path) -> None:
    """The script in deploy/grafana adds the service's name to the metrics, and removes those of an ended service."""
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
    errors = await_recording(bench, ticks)["x_error_um"][:ticks]
    closed = await_recording(bench, ticks)["mode"][:ticks] == 3
    assert ticks > RATE_HZ
    assert sums["rtloop_closed_loop_ticks_total"] == np.count_nonzero(closed)
    assert sums["rtloop_error_square_um2_total"] == pytest.approx(np.sum(errors[closed] ** 2), rel=1e-9)


def test_it_is_shown(command_result: CommandResult) -> None:
    for word in ("gain margin", "phase margin", "modulus margin", "resonance", "moved by"):
        assert word in command_result.text
    assert command_result.picture.startswith(b"\x89PNG")


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
    client = subprocess.Popen(command, env=bench.environment, stderr=subprocess.PIPE, text=True)
    wait_for(lambda: reference_um(bench) != SETPOINT_UM, "an excitation")
    client.send_signal(signal.SIGINT)
    _, message = client.communicate(timeout=60)
    assert (client.returncode, "holds 5 µm as before" in message) == (1, True), message
    assert reference_um(bench) == SETPOINT_UM


def test_all_that_the_dashboard_asks_for_is_there(bench: Bench, command_result: CommandResult) -> None:
    """The service exports `rtloop_trip` only while a trip is in force."""
    served = {
        sample.name
        for family in text_string_to_metric_families(bench.client.get("/metrics"))
        for sample in family.samples
    }
    board = json.loads(DASHBOARD.read_text())
    used = {name for panel in board["panels"] for target in panel["targets"] for name in METRIC.findall(target["expr"])}
    assert len(used) > 20
    assert used - served == {"rtloop_trip"}
    assert METRIC.findall(board["templating"]["list"][1]["query"]["query"]) == ["rtloop_ticks"]
    new = {"rtloop_error_square_um2_total", "rtloop_drive_square_v2_total", "rtloop_tick_lateness_seconds_bucket"}
    assert new <= used
    assert not [name for name in served - used if name.endswith("_total")]


def test_a_loop_that_runs_and_does_not_control_is_told(bench: Bench) -> None:
    """A drive of 1 V reaches 4.3 µm of the required 5 µm; the noise alone exceeds a tenth of a nanometre."""

    def tune(**limits: float | None) -> None:
        bench.client.post("/tune", {"axis": "x", "section": "limits", "values": limits})

    def exported_condition() -> str:
        (family,) = (family for family in text_string_to_metric_families(bench.client.get("/metrics"))
                     if family.name == "rtloop_condition")  # fmt: skip
        (condition,) = (sample.labels["condition"] for sample in family.samples if sample.value == 1.0)
        assert next(bench.client.watch())["condition"] == bench.status()["condition"] == {"x": condition}
        return condition

    wait_for(lambda: bench.status()["condition"] == {"x": "controlled"}, "a loop that controls")
    tune(drive_v=1.0)
    wait_for(lambda: bench.status()["condition"] != {"x": "controlled"}, "another condition")
    assert exported_condition() == "saturated"
    tune(drive_v=10.0, settled_within_um=1e-4)
    wait_for(lambda: bench.status()["condition"] == {"x": "not settled"}, "another condition")
    assert exported_condition() == "not settled"
    assert bench.status()["state"] == "running"
    tune(settled_within_um=None)
    wait_for(lambda: bench.status()["condition"] == {"x": "controlled"}, "a loop that controls")


def test_a_service_that_ends_says_so_to_who_still_measures(bench: Bench) -> None:
    """End the shared service. This test must be the last of the file."""
    answers: list[tuple[int, Any]] = []
    thread = threading.Thread(target=lambda: answers.append(answer(bench, "POST", "/response", QUICK_REQUEST)))
    thread.start()
    wait_for(lambda: reference_um(bench) != SETPOINT_UM, "an excitation")
    assert bench.stop() == 0
    thread.join()
    assert answers == [(503, {"error": "response: the service is ending and takes no more requests"})]
    assert "Traceback" not in bench.log()
