"""A running service learns a scan: the error falls, what is learned goes on, what cannot be learned is refused."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rtloop.cli import main
from tests.design.measured_loops import margins_of
from tests.faults.bench import Bench
from tests.service.http import answer
from tests.service.test_response import CONFIGURATION, HELD_UM, LOOP, OMEGA, QUICK

MODEL = f"""
[axis.model]
form = "factors"
gain = {OMEGA**2!r}
denominator = [[1.0, {2 * LOOP.damping * OMEGA!r}, {OMEGA**2!r}]]
"""
"""It says nothing of a delay: what the rig's driver has is in the loop all the same."""
TICKS = 100
WANTED_UM = HELD_UM + 4.0 * np.sin(2 * np.pi * np.arange(TICKS) / TICKS)
ASKED = {"axis": "x", "samples": WANTED_UM.tolist(), "cycles": 3}


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    folder = tmp_path_factory.mktemp("learn")
    text = CONFIGURATION.replace("[axis.interlocks]", MODEL + "[axis.interlocks]")
    with Bench(folder, board=False, text=text.replace("FOLDER", str(folder))) as bench:
        bench.await_state("running")
        yield bench


def held(bench: Bench) -> None:
    bench.client.post("/setpoint", {"axis": "x", "value": HELD_UM})


def test_a_scan_is_learned_and_goes_on(running: Bench, tmp_path: Path):
    held(running)
    (tmp_path / "wanted.csv").write_text("\n".join(map(repr, WANTED_UM.tolist())))
    arguments = ["ctl", "--socket", str(running.client.path), "learn", "x", str(tmp_path / "wanted.csv")]
    ran = CliRunner().invoke(main, [*arguments, "--cycles", "3", "--out", str(tmp_path / "learned.csv"), "--json"])
    assert ran.exit_code == 0, ran.output
    found = json.loads(ran.stdout)
    errors = [cycle["rms_um"] for cycle in found["cycles"]]
    assert errors[0] > 0.5
    assert min(errors) < errors[0] / 20
    learned = np.loadtxt(tmp_path / "learned.csv", delimiter=",")
    np.testing.assert_array_equal(learned.T, [found["reference_um"], found["command_um"]])
    held(running)
    again = CliRunner().invoke(main, [*arguments[:3], "waveform", "x", str(tmp_path / "learned.csv"), "--repeat"])
    assert again.exit_code == 0, again.output
    held(running)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"cycles": 0}, "cycles"),
        ({"samples": [1.0, 2.0]}, "samples: "),
        ({"samples": [99.0] * 8}, "reaches 99, beyond"),
        ({"samples": [5.0] * 100_000, "cycles": 50}, "at most 300 s are allowed"),
        ({"axis": "z"}, "axis 'z': there are x"),
    ],
)
def test_what_cannot_be_learned_is_refused_with_the_reason(running: Bench, change: dict[str, object], said: str):
    held(running)
    code, told = answer(running, "POST", "/learn", ASKED | change)
    assert code == 422
    assert said in json.dumps(told)
    assert running.client.get("/status")["axes"]["x"]["reference_um"] == pytest.approx(HELD_UM)


def test_the_rigs_delay_is_in_the_loop_that_is_promised(running: Bench):
    held(running)
    found = running.client.post("/response", QUICK, 60.0)
    true = margins_of(LOOP.open, found["from_hz"], found["to_hz"])
    promised = found["model"]["margins"]
    assert promised["gain_margin"] == pytest.approx(true["gain_margin"], rel=1e-3)
    assert promised["phase_margin_deg"] == pytest.approx(true["phase_margin_deg"], abs=0.05)
