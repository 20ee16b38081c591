"""A running service learns a scan: the error falls, what is learned goes on, what cannot be learned is refused."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rtloop.cli import main
from tests.design.measured_loops import margins_of
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
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
LONG_CYCLES = 50
JUDGED_TICKS = 5000
"""After so many ticks of learning a first table has been judged, and others are being tried."""
BACK_S = 10.0
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
        ({"samples": [99.0] * 8}, "reaches a magnitude of 99 µm; allowed"),
        ({"samples": [5.0] * 100_000, "cycles": 50}, "allowed: at most 300 s"),
        ({"axis": "z"}, "axis 'z': unknown; allowed: x"),
    ],
)
def test_what_cannot_be_learned_is_refused_with_the_reason(running: Bench, change: dict[str, object], said: str):
    held(running)
    code, told = answer(running, "POST", "/learn", ASKED | change)
    assert code == 422
    assert said in json.dumps(told, ensure_ascii=False)
    assert running.client.get("/status")["axes"]["x"]["reference_um"] == pytest.approx(HELD_UM)


def test_the_rigs_delay_is_in_the_loop_that_is_promised(running: Bench):
    held(running)
    found = running.client.post("/response", QUICK, 60.0)
    true = margins_of(LOOP.open, found["from_hz"], found["to_hz"])
    promised = found["model"]["margins"]
    assert promised["gain_margin"] == pytest.approx(true["gain_margin"], rel=1e-3)
    assert promised["phase_margin_deg"] == pytest.approx(true["phase_margin_deg"], abs=0.05)


def reference_um(bench: Bench) -> float:
    return bench.client.get("/status")["axes"]["x"]["reference_um"]


def holds_as_before(bench: Bench) -> None:
    """What was held comes back within BACK_S, as a hold about which the next measurement may begin, and stays."""
    wait_for(lambda: reference_um(bench) == HELD_UM, "the held reference", BACK_S)
    seen, end = set[float](), bench.ticks + 4 * TICKS
    while bench.ticks < end:
        seen.add(reference_um(bench))
    assert seen == {HELD_UM}
    refused = ASKED | {"samples": [5.0] * 100_000, "cycles": 50}
    wait_for(lambda: answer(bench, "POST", "/learn", refused)[0] == 422, "an end of the measurement", BACK_S)


def kill_client(bench: Bench, tmp_path: Path, number: int) -> str:
    """Have a real client learn, and end it by a signal while tables are tried; what it said on stderr."""
    (tmp_path / "wanted.csv").write_text("\n".join(map(repr, WANTED_UM.tolist())))
    words = ["ctl", "--socket", bench.client.path, "learn", "x", tmp_path / "wanted.csv", "--cycles", str(LONG_CYCLES)]
    command = [sys.executable, "-m", "rtloop", *map(str, words)]
    with subprocess.Popen(command, env=bench.environment, stderr=subprocess.PIPE, text=True) as client:
        try:
            await_tables(bench)
            client.send_signal(number)
            return client.communicate(timeout=60)[1]
        finally:
            client.kill()


def cut_connection(bench: Bench) -> None:
    """Ask as a client does, and close the socket while tables are tried."""
    body = json.dumps(ASKED | {"cycles": LONG_CYCLES}).encode()
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(str(bench.client.path))
        head = f"POST /learn HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(body)}\r\n\r\n"
        connection.sendall(head.encode() + body)
        await_tables(bench)


def await_tables(bench: Bench) -> None:
    wait_for(lambda: reference_um(bench) != HELD_UM, "a table that is played")
    tick = bench.ticks
    wait_for(lambda: bench.ticks > tick + JUDGED_TICKS, "tables that were judged")


ENDINGS: dict[str, Callable[[Bench, Path], object]] = {
    "SIGKILL": lambda bench, folder: kill_client(bench, folder, signal.SIGKILL),
    "SIGTERM": lambda bench, folder: kill_client(bench, folder, signal.SIGTERM),
    "Ctrl-C": lambda bench, folder: kill_client(bench, folder, signal.SIGINT),
    "connection cut": lambda bench, _: cut_connection(bench),
}


@pytest.mark.parametrize("ending", ENDINGS)
def test_learning_ends_with_its_client_and_the_held_reference_comes_back(running: Bench, tmp_path: Path, ending: str):
    held(running)
    ENDINGS[ending](running, tmp_path)
    holds_as_before(running)
