"""A running service learns a scan: the error falls, the result can be played, and an invalid request is refused."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from rtloop.cli import main
from tests.design.measured_loops import compute_margins
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.service.http import answer
from tests.service.test_response import CONFIGURATION, LOOP, OMEGA, QUICK_REQUEST, RATE_HZ, SETPOINT_UM
from tests.stage_text import resonance

MODEL = f"""
[axis.model]
{resonance(OMEGA, LOOP.damping)}"""
"""Model of the plant without a delay; the loop's promise includes the delay of the rig's driver."""
TICKS = 100
SCAN_UM = SETPOINT_UM + 4.0 * np.sin(2 * np.pi * np.arange(TICKS) / TICKS)
LONG_CYCLES = 50
JUDGED_TICKS = 5000
"""Ticks of learning after which the first table has been evaluated, and further tables are tried."""
RETURN_S = 10.0
REQUEST = {"axis": "x", "samples": SCAN_UM.tolist(), "cycles": 3}


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Yield a running service whose axis has a model."""
    folder = tmp_path_factory.mktemp("learn")
    text = CONFIGURATION.replace("[axis.interlocks]", MODEL + "[axis.interlocks]")
    with Bench(folder, board=False, text=text.replace("FOLDER", str(folder))) as bench:
        bench.await_state("running")
        yield bench


def hold_setpoint(bench: Bench) -> None:
    """Set the reference to the constant SETPOINT_UM."""
    bench.client.post("/setpoint", {"axis": "x", "value": SETPOINT_UM})


def test_a_scan_is_learned_and_goes_on(running: Bench, tmp_path: Path):
    hold_setpoint(running)
    (tmp_path / "scan.csv").write_text("\n".join(map(repr, SCAN_UM.tolist())))
    arguments = ["ctl", "--socket", str(running.client.path), "learn", "x", str(tmp_path / "scan.csv")]
    result = CliRunner().invoke(main, [*arguments, "--cycles", "3", "--out", str(tmp_path / "learned.csv"), "--json"])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    errors = [cycle["rms_um"] for cycle in report["cycles"]]
    assert errors[0] > 0.5
    assert min(errors) < errors[0] / 20
    learned = np.loadtxt(tmp_path / "learned.csv", delimiter=",")
    np.testing.assert_array_equal(learned.T, [report["reference_um"], report["command_um"]])
    hold_setpoint(running)
    replay = CliRunner().invoke(main, [*arguments[:3], "waveform", "x", str(tmp_path / "learned.csv"), "--repeat"])
    assert replay.exit_code == 0, replay.output
    hold_setpoint(running)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cycles": 0}, "cycles"),
        ({"samples": [1.0, 2.0]}, "samples: "),
        ({"samples": [99.0] * 8}, "reaches a magnitude of 99 µm; allowed"),
        ({"samples": [5.0] * 100_000, "cycles": 50}, "allowed: at most 300 s"),
        ({"axis": "z"}, "axis 'z': unknown; allowed: x"),
    ],
)
def test_what_cannot_be_learned_is_refused_with_the_reason(running: Bench, change: dict[str, object], message: str):
    hold_setpoint(running)
    code, response = answer(running, "POST", "/learn", REQUEST | change)
    assert code == 422
    assert message in json.dumps(response, ensure_ascii=False)
    assert running.client.get("/status")["axes"]["x"]["reference_um"] == pytest.approx(SETPOINT_UM)


def test_the_rigs_delay_is_in_the_loop_that_is_promised(running: Bench):
    hold_setpoint(running)
    measurement = running.client.post("/response", QUICK_REQUEST, 60.0)
    true = compute_margins(LOOP.open, measurement["from_hz"], measurement["to_hz"])
    promised = measurement["model"]["margins"]
    assert promised["gain_margin"] == pytest.approx(true["gain_margin"], rel=1e-3)
    assert promised["phase_margin_deg"] == pytest.approx(true["phase_margin_deg"], abs=0.05)


def reference_um(bench: Bench) -> float:
    """Return the present reference (µm) of axis x."""
    return bench.client.get("/status")["axes"]["x"]["reference_um"]


def assert_reference_returns(bench: Bench) -> None:
    """Check that the reference returns to SETPOINT_UM within RETURN_S and stays, and that the measurement has ended."""
    wait_for(lambda: reference_um(bench) == SETPOINT_UM, "the held reference", RETURN_S)
    references_um, end = set[float](), bench.ticks + 4 * TICKS
    while bench.ticks < end:
        references_um.add(reference_um(bench))
    assert references_um == {SETPOINT_UM}
    too_long = REQUEST | {"samples": [5.0] * 100_000, "cycles": 50}
    wait_for(lambda: answer(bench, "POST", "/learn", too_long)[0] == 422, "the end of the measurement", RETURN_S)


def kill_client(bench: Bench, tmp_path: Path, number: int) -> str:
    """Start a client process that learns, send it signal `number` while tables are tried, and return its stderr."""
    (tmp_path / "scan.csv").write_text("\n".join(map(repr, SCAN_UM.tolist())))
    options = ["ctl", "--socket", bench.client.path, "learn", "x", tmp_path / "scan.csv", "--cycles", str(LONG_CYCLES)]
    command = [sys.executable, "-m", "rtloop", *map(str, options)]
    with subprocess.Popen(command, env=bench.environment, stderr=subprocess.PIPE, text=True) as client:
        try:
            await_tables(bench)
            client.send_signal(number)
            return client.communicate(timeout=60)[1]
        finally:
            client.kill()


def cut_connection(bench: Bench) -> None:
    """Send a learn request on a socket, and close the socket while tables are tried."""
    body = json.dumps(REQUEST | {"cycles": LONG_CYCLES}).encode()
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(str(bench.client.path))
        head = f"POST /learn HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(body)}\r\n\r\n"
        connection.sendall(head.encode() + body)
        await_tables(bench)


def await_tables(bench: Bench) -> None:
    """Wait until a table is played, and then until JUDGED_TICKS ticks have passed."""
    wait_for(lambda: reference_um(bench) != SETPOINT_UM, "a table that is played")
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
    hold_setpoint(running)
    ENDINGS[ending](running, tmp_path)
    assert_reference_returns(running)


def learn_until(bench: Bench, end: Callable[[], Any]) -> tuple[Any, int, Any]:
    """Learn from the setpoint, call `end` while tables are tried; return its result, and status and body of /learn."""
    hold_setpoint(bench)
    answers: list[tuple[int, Any]] = []
    request = REQUEST | {"cycles": LONG_CYCLES}
    learning = threading.Thread(target=lambda: answers.append(answer(bench, "POST", "/learn", request)))
    learning.start()
    await_tables(bench)
    result = end()
    learning.join()
    ((code, text),) = answers
    return result, code, text


def test_a_learning_that_trips_leaves_the_setpoint_as_reference(running: Bench):
    """After a reset the stage returns to its setpoint, and does not scan."""
    tight = {"axis": "x", "section": "interlocks", "values": {"position_um": 3.0}}
    _, code, text = learn_until(running, lambda: running.client.post("/tune", tight))
    assert (code, "the loop tripped (position" in text["error"]) == (409, True), text
    assert reference_um(running) == SETPOINT_UM
    running.client.post("/undo", {"axis": "x"})
    running.client.post("/reset")
    running.client.post("/start")
    running.await_state("running")
    assert_reference_returns(running)


def test_a_learning_in_which_the_mode_becomes_raw_leaves_the_drive_as_it_is(running: Bench):
    response, code, text = learn_until(running, lambda: running.client.post("/mode", {"mode": "raw"}))
    assert (code, "the mode is not closed_loop" in text["error"]) == (409, True), text
    wait_for(lambda: running.ticks > response["tick"] + RATE_HZ, "a second in raw mode")
    axis = running.client.get("/status")["axes"]["x"]
    assert axis["drive_v"] == axis["reference_um"] != SETPOINT_UM
    running.client.post("/mode", {"mode": "closed_loop"})
    hold_setpoint(running)
    assert_reference_returns(running)
