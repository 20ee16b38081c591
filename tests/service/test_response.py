"""A running service measures its own loop; the rig's true loop is the oracle. The held reference returns afterwards."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from rtloop.cli import main
from tests.design.measured_loops import RATE_HZ, TrueLoop, compute_margins
from tests.stage_text import one_axis, simulated_stage
from tests.virtual.bench import VirtualBench

LOOP = TrueLoop(800.0, 0.02, 1, 100.0, kp=0.01)
OMEGA = 2 * np.pi * LOOP.hz
SETPOINT_UM = 5.0
QUICK_REQUEST = {"axis": "x", "duration_s": 1.0, "period_s": 0.25, "near_hz": 800.0}
CONFIGURATION = f"""
[loop]
rate_hz = {RATE_HZ:g}
{simulated_stage(OMEGA, LOOP.damping, 4.3, seed=3, latency_ticks=LOOP.delay_ticks)}
{one_axis()}
[axis.controller]
kind = "pid"
kp = {LOOP.kp}
ki_per_s = {LOOP.ki_per_s}
[axis.interlocks]
position_um = 30.0
[axis.reference]
kind = "hold"
value = {SETPOINT_UM}
[recording]
folder = "FOLDER/recordings"
"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[VirtualBench]:
    """Yield a service whose loop runs on the rig of LOOP, in virtual time."""
    with pytest.MonkeyPatch.context() as patch:
        bench = VirtualBench(tmp_path_factory.mktemp("response"), patch, CONFIGURATION)
        bench.await_state("running")
        bench.turns.sleep(0.5)
        yield bench
        bench.end()


def reference_um(bench: VirtualBench) -> float:
    """Return the present reference (µm) of axis x."""
    return bench.status()["axes"]["x"]["reference_um"]


def test_margins_and_motion_are_those_of_the_rig(bench: VirtualBench) -> None:
    start = bench.ticks
    measurement = bench.client.post("/response", QUICK_REQUEST | {"amplitude_um": 0.6}, 60.0)
    true = compute_margins(LOOP.open, measurement["from_hz"], measurement["to_hz"])
    for name in ("gain_margin", "phase_margin_deg", "modulus_margin"):
        margin = measurement["margins"][name]
        assert 0.0 < margin["std"] < 0.02 * true[name], margin
        error = abs(margin["value"] - true[name])
        assert error < 0.05 * true[name], margin
        assert error < 8.0 * margin["std"], margin  # from four periods: Student's t exceeds 5 too often
    assert measurement["resonance"]["hz"] == pytest.approx(LOOP.hz, rel=0.002)
    assert measurement["model"] is None
    assert reference_um(bench) == SETPOINT_UM
    assert 0.1 < np.abs(bench.column("x_true_position_um")[start:] - SETPOINT_UM).max() <= 0.6


def test_the_gain_at_rest_is_measured_and_told(bench: VirtualBench) -> None:
    """The rig's gain at rest is 1: the inverse fits the actuator, and D(0) = 1."""
    request = {"axis": "x", "duration_s": 1.0, "resonance_only": True, "near_hz": 800.0, "gain_um": 4.0}
    gain = bench.client.post("/response", request, 60.0)["gain"]
    assert (gain["from_um"], gain["to_um"]) == (SETPOINT_UM, SETPOINT_UM - 4.0)
    assert 0.0 < gain["std"] < 0.002
    assert abs(gain["value"] - 1.0) < 4.0 * gain["std"]
    assert bench.status()["measured"]["x"]["gain"] == gain
    assert f'rtloop_gain{{axis="x"}} {gain["value"]!r}' in bench.client.get("/metrics")
    assert reference_um(bench) == SETPOINT_UM


def test_a_resonance_alone_is_measured_as_well(bench: VirtualBench) -> None:
    quick = ("--duration", "1", "--near-hz", "780", "--json")
    result = CliRunner().invoke(main, ["ctl", "--socket", str(bench.client.path), "resonance", "x", *quick])
    measurement = json.loads(result.stdout)
    assert measurement["resonance"]["hz"] == pytest.approx(LOOP.hz, rel=0.0006)
    assert measurement["resonance"]["damping"] == pytest.approx(LOOP.damping, rel=0.05)


@pytest.mark.parametrize(
    ("change", "expected_code", "message"),
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
def test_what_makes_no_sense_is_refused(
    bench: VirtualBench, change: dict[str, Any], expected_code: int, message: str
) -> None:
    code, text = bench.answer("POST", "/response", {**QUICK_REQUEST, **change})
    assert (code, message in text["error"]) == (expected_code, True), text
    assert reference_um(bench) == SETPOINT_UM


def test_only_a_held_reference_in_closed_loop_is_measured(bench: VirtualBench) -> None:
    wave = {"kind": "sine", "amplitude": 1.0, "frequency_hz": 1.0}
    bench.client.post("/reference", {"axis": "x", "reference": wave})
    code, text = bench.answer("POST", "/response", QUICK_REQUEST)
    assert (code, "kind is sine; allowed: hold" in text["error"]) == (409, True), text
    bench.client.post("/setpoint", {"axis": "x", "value": SETPOINT_UM})
    bench.client.post("/mode", {"mode": "feedforward"})
    code, text = bench.answer("POST", "/response", QUICK_REQUEST)
    assert (code, "the mode is not closed_loop" in text["error"]) == (409, True), text
    bench.client.post("/mode", {"mode": "closed_loop"})
    bench.client.post("/stop")
    code, text = bench.answer("POST", "/response", QUICK_REQUEST)
    assert (code, "needs a running loop" in text["error"]) == (409, True), text
    bench.client.post("/start")
    bench.await_state("running")


def test_out_of_raw_mode_the_measurement_is_about_the_position_that_is_held(bench: VirtualBench) -> None:
    """The setpoint of 1 V has become the held position of 4.3 µm."""
    bench.client.post("/mode", {"mode": "raw"})
    code, text = bench.answer("POST", "/response", QUICK_REQUEST)
    assert (code, "the mode is not closed_loop" in text["error"]) == (409, True), text
    bench.client.post("/setpoint", {"axis": "x", "value": 1.0})
    tick = bench.ticks
    bench.wait_for(lambda: bench.ticks > tick + RATE_HZ // 5, "a position at rest")
    bench.client.post("/mode", {"mode": "closed_loop"})
    held_um = reference_um(bench)
    assert held_um == pytest.approx(4.3, abs=0.5)
    code, measurement = bench.answer("POST", "/response", QUICK_REQUEST)
    assert code == 200, measurement
    assert reference_um(bench) == held_um
    bench.client.post("/setpoint", {"axis": "x", "value": SETPOINT_UM})


def test_whoever_sets_a_reference_meanwhile_ends_the_measurement(bench: VirtualBench) -> None:
    """The measurement ends with an error, and leaves the reference of the other client as it is."""

    def set_another() -> None:
        bench.wait_for(lambda: reference_um(bench) != SETPOINT_UM, "an excitation")
        assert bench.answer("POST", "/response", QUICK_REQUEST)[0] == 503
        bench.client.post("/setpoint", {"axis": "x", "value": 4.0})

    _, code, text = bench.answer_meanwhile("/response", QUICK_REQUEST, set_another)
    assert (code, "another client has set a reference" in text["error"]) == (409, True), text
    assert reference_um(bench) == 4.0
    bench.client.post("/setpoint", {"axis": "x", "value": SETPOINT_UM})


def test_a_measurement_that_fails_returns_to_the_setpoint(bench: VirtualBench) -> None:
    def leave_closed_loop() -> None:
        bench.wait_for(lambda: reference_um(bench) != SETPOINT_UM, "an excitation")
        bench.client.post("/mode", {"mode": "feedforward"})

    _, code, text = bench.answer_meanwhile("/response", QUICK_REQUEST, leave_closed_loop)
    assert (code, "the mode is not closed_loop" in text["error"]) == (409, True), text
    assert reference_um(bench) == SETPOINT_UM
    bench.client.post("/mode", {"mode": "closed_loop"})


def test_a_loop_that_trips_is_left_to_its_interlocks(bench: VirtualBench) -> None:
    def tighten() -> None:
        bench.wait_for(lambda: reference_um(bench) != SETPOINT_UM, "an excitation")
        bench.client.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 3.0}})

    _, code, text = bench.answer_meanwhile("/response", QUICK_REQUEST, tighten)
    assert (code, "the loop tripped (position" in text["error"]) == (409, True), text
    bench.client.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 30.0}})
    bench.client.post("/reset")
    bench.client.post("/start")
    bench.await_state("running")
