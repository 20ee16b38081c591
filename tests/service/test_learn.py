"""A running service learns a scan: the error falls, the result can be played, and an invalid request is refused."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from rtloop.cli import main
from rtloop.service.measuring.player import Player
from tests.design.measured_loops import compute_margins
from tests.service.test_response import CONFIGURATION, LOOP, OMEGA, QUICK_REQUEST, RATE_HZ, SETPOINT_UM
from tests.stage_text import resonance
from tests.virtual.bench import VirtualBench

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
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[VirtualBench]:
    """Yield a running service in virtual time, whose axis has a model."""
    text = CONFIGURATION.replace("[axis.interlocks]", MODEL + "[axis.interlocks]")
    with pytest.MonkeyPatch.context() as patch:
        bench = VirtualBench(tmp_path_factory.mktemp("learn"), patch, text)
        bench.await_state("running")
        yield bench
        bench.end()


def hold_setpoint(bench: VirtualBench) -> None:
    """Set the reference to the constant SETPOINT_UM."""
    bench.client.post("/setpoint", {"axis": "x", "value": SETPOINT_UM})


def test_a_scan_is_learned_and_goes_on(running: VirtualBench, tmp_path: Path):
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
    running.turns.sleep(1.0)
    period_um = running.column("x_position_um")[-20 * TICKS :].reshape(-1, TICKS).mean(axis=0)
    assert min(np.std(period_um - np.roll(SCAN_UM, shift)) for shift in range(TICKS)) < errors[0] / 20
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
def test_what_cannot_be_learned_is_refused_with_the_reason(
    running: VirtualBench, change: dict[str, object], message: str
):
    hold_setpoint(running)
    code, response = running.answer("POST", "/learn", REQUEST | change)
    assert code == 422
    assert message in json.dumps(response, ensure_ascii=False)
    assert running.client.get("/status")["axes"]["x"]["reference_um"] == pytest.approx(SETPOINT_UM)


def test_the_rigs_delay_is_in_the_loop_that_is_promised(running: VirtualBench):
    hold_setpoint(running)
    measurement = running.client.post("/response", QUICK_REQUEST, 60.0)
    true = compute_margins(LOOP.open, measurement["from_hz"], measurement["to_hz"])
    promised = measurement["model"]["margins"]
    assert promised["gain_margin"] == pytest.approx(true["gain_margin"], rel=1e-3)
    assert promised["phase_margin_deg"] == pytest.approx(true["phase_margin_deg"], abs=0.05)


def reference_um(bench: VirtualBench) -> float:
    """Return the present reference (µm) of axis x."""
    return bench.client.get("/status")["axes"]["x"]["reference_um"]


def assert_reference_returns(bench: VirtualBench) -> None:
    """Check that the reference returns to SETPOINT_UM within RETURN_S and stays, and that the measurement has ended."""
    bench.wait_for(lambda: reference_um(bench) == SETPOINT_UM, "the held reference", RETURN_S)
    references_um, end = set[float](), bench.ticks + 4 * TICKS
    while bench.ticks < end:
        bench.turns.sleep(0.001)
        references_um.add(reference_um(bench))
    assert references_um == {SETPOINT_UM}
    too_long = REQUEST | {"samples": [5.0] * 100_000, "cycles": 50}
    bench.wait_for(lambda: bench.answer("POST", "/learn", too_long)[0] == 422, "the end of the measurement", RETURN_S)


def await_tables(bench: VirtualBench) -> None:
    """Wait until a table is played, and then until JUDGED_TICKS ticks have passed."""
    bench.wait_for(lambda: reference_um(bench) != SETPOINT_UM, "a table that is played")
    tick = bench.ticks
    bench.wait_for(lambda: bench.ticks > tick + JUDGED_TICKS, "tables that were judged")


def assert_setpoint_is_kept_over_a_reset(bench: VirtualBench) -> None:
    """Undo the tight interlock, reset and start, and check that the reference is SETPOINT_UM."""
    bench.client.post("/undo", {"axis": "x"})
    bench.client.post("/reset")
    bench.client.post("/start")
    bench.await_state("running")
    assert_reference_returns(bench)


def learn_until(bench: VirtualBench, end: Callable[[], Any]) -> tuple[Any, int, Any]:
    """Learn from the setpoint, call `end` while tables are tried; return its result, and status and body of /learn."""
    hold_setpoint(bench)

    def meanwhile() -> Any:
        await_tables(bench)
        return end()

    return bench.answer_meanwhile("/learn", REQUEST | {"cycles": LONG_CYCLES}, meanwhile)


def test_a_learning_that_trips_leaves_the_setpoint_as_reference(running: VirtualBench):
    """After a reset the stage returns to its setpoint, and does not scan. Until the trip, the status has the rms errors
    of all cycles, first of the one without learning.
    """
    tight = {"axis": "x", "section": "interlocks", "values": {"position_um": 3.0}}

    def read_progress_and_trip() -> Any:
        running.wait_for(lambda: len(running.status()["measuring"]["rms_um"]) == 2, "a cycle with a learned table")
        progress = running.status()["measuring"]
        running.client.post("/tune", tight)
        return progress

    progress, code, text = learn_until(running, read_progress_and_trip)
    assert (progress["activity"], progress["axis"], progress["cycles"]) == ("learn", "x", LONG_CYCLES)
    assert progress["rms_um"][0] > max(0.5, 3.0 * progress["rms_um"][1])
    assert (code, "the loop tripped (position" in text["error"]) == (409, True), text
    assert reference_um(running) == SETPOINT_UM
    assert_setpoint_is_kept_over_a_reset(running)


def test_a_learning_in_which_the_mode_becomes_raw_leaves_the_drive_as_it_is(running: VirtualBench):
    response, code, text = learn_until(running, lambda: running.client.post("/mode", {"mode": "raw"}))
    assert (code, "the mode is not closed_loop" in text["error"]) == (409, True), text
    running.wait_for(lambda: running.ticks > response["tick"] + RATE_HZ, "a second in raw mode")
    axis = running.client.get("/status")["axes"]["x"]
    assert axis["drive_v"] == axis["reference_um"] != SETPOINT_UM
    running.client.post("/mode", {"mode": "closed_loop"})
    hold_setpoint(running)
    assert_reference_returns(running)


def test_a_trip_as_the_best_table_begins_leaves_the_setpoint_as_reference(
    running: VirtualBench, monkeypatch: pytest.MonkeyPatch
):
    """The loop trips after the last table has been set, and before the service looks again."""
    hold_setpoint(running)
    play = Player.play

    def play_and_trip(player: Player, samples: Any, *, repeat: bool = False) -> int:
        tick = play(player, samples, repeat=repeat)
        if repeat:
            assert running.service.live is not None
            running.service.live.tune("x", "interlocks", {"position_um": 3.0})
            running.wait_for(lambda: running.service.state == "tripped", "a trip")
        return tick

    monkeypatch.setattr(Player, "play", play_and_trip)
    running.answer("POST", "/learn", REQUEST | {"keep": True})
    assert reference_um(running) == SETPOINT_UM
    assert_setpoint_is_kept_over_a_reset(running)
