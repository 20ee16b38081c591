"""Measurements from the panel agree with the rig, and end when their page disconnects."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from rtloop.client import Client
from tests.design.measured_loops import compute_margins
from tests.panel.measurement_rig import MODEL_HZ, SCAN_UM, TICKS, make_configuration
from tests.service.test_response import LOOP, QUICK_REQUEST, SETPOINT_UM
from tests.virtual.bench import VirtualBench
from tests.virtual.panel import VirtualPage

LEARN = {"axis": "x", "samples": SCAN_UM.tolist(), "cycles": 3, "keep": False}
END_S = 1.0
"""Virtual time in which a measurement begins, and ends after its page has disconnected; each would last for seconds."""
RETUNE = {"axis": "x", "within_percent": 0.0}


@pytest.fixture(scope="module")
def patch() -> Iterator[pytest.MonkeyPatch]:
    """Yield what patches the product for the tests of this file."""
    with pytest.MonkeyPatch.context() as patch:
        yield patch


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory, patch: pytest.MonkeyPatch) -> Iterator[VirtualBench]:
    """Yield the bench of the measurement rig, with its loop running."""
    folder = tmp_path_factory.mktemp("measurements")
    bench = VirtualBench(folder, patch, make_configuration(folder))
    bench.await_state("running")
    yield bench
    bench.end()


@pytest.fixture(scope="module")
def page(bench: VirtualBench, patch: pytest.MonkeyPatch) -> VirtualPage:
    """Return a logged-in page of the service's panel."""
    return VirtualPage(bench, patch)


@pytest.fixture(scope="module")
def proposal(page: VirtualPage) -> dict[str, Any]:
    """Return the proposal of a retuning of axis x."""
    status, proposal = page.json("POST", "/api/retune?as=ada", RETUNE)
    assert status == 200, proposal
    return proposal


def reference_um(bench: VirtualBench) -> float:
    """Return the present reference of axis x."""
    return bench.client.get("/status")["axes"]["x"]["reference_um"]


def taps(bench: VirtualBench) -> list[float]:
    """Return the taps of the prefilter in force; none without a prefilter."""
    return bench.client.get("/configuration")["values"]["axis"][0].get("prefilter", {}).get("taps", [])


def swap_body(proposal: dict[str, Any]) -> dict[str, Any]:
    """Return the body of the request that swaps in the proposed prefilter."""
    return {"axis": "x", **{key: proposal[key] for key in ("replaces", "prefilter")}}


def test_measured_margins_agree_with_the_rig(page: VirtualPage, bench: VirtualBench):
    status, result = page.json("POST", "/api/response?as=ada", QUICK_REQUEST)
    assert status == 200, result
    true = compute_margins(LOOP.open, result["from_hz"], result["to_hz"])
    for name in ("gain_margin", "phase_margin_deg", "modulus_margin"):
        margin = result["margins"][name]
        # The spread comes from three periods: Student's t with 4 degrees of freedom exceeds 10 in 6 of 10,000 cases.
        assert abs(margin["value"] - true[name]) < 10.0 * margin["std"], margin
        assert margin["std"] < 0.02 * true[name]
    curves = result["response"]
    sensitivity = np.array(curves["sensitivity"]) @ (1, 1j)
    true_loop = LOOP.open(np.array(curves["hz"]))
    is_far = np.abs(sensitivity * (1 + true_loop) - 1) > 6 * np.array(curves["sensitivity_spread"])
    assert np.mean(is_far) < 0.01
    model = np.array(curves["model_loop"]) @ (1, 1j)
    np.testing.assert_allclose(np.array(curves["model_sensitivity"]) @ (1, 1j), 1 / (1 + model), rtol=1e-9)
    assert reference_um(bench) == SETPOINT_UM


def test_learning_shows_its_progress_and_keeps_no_table_without_consent(page: VirtualPage, bench: VirtualBench):
    responses: list[tuple[int, Any]] = []
    request = bench.start(lambda: responses.append(page.json("POST", "/api/learn?as=ada", LEARN)))
    progress: list[dict[str, Any]] = []
    while request.is_alive():
        progress += [measuring] if (measuring := bench.status()["measuring"]) else []
        bench.turns.sleep(0.01)
    ((status, result),) = responses
    assert status == 200, result
    assert {(entry["activity"], entry["axis"], entry["cycles"]) for entry in progress} == {("learn", "x", 3)}
    errors = [cycle["rms_um"] for cycle in result["cycles"]]
    assert errors[: len(progress[-1]["rms_um"])] == progress[-1]["rms_um"]
    assert len(progress[-1]["rms_um"]) >= 2
    assert min(errors) < errors[0] / 20
    assert bench.status()["measuring"] is None
    assert reference_um(bench) == SETPOINT_UM
    table = {"axis": "x", "samples": result["reference_um"], "command_um": result["command_um"], "repeat": True}
    assert page.json("POST", "/api/waveform?as=ada", table)[0] == 200
    bench.wait_for(lambda: abs(reference_um(bench) - SETPOINT_UM) > 1.0, "the table that plays")
    assert page.json("POST", "/api/setpoint?as=ada", {"axis": "x", "value": SETPOINT_UM})[0] == 200


def test_nothing_changes_before_consent_and_then_the_taps_are_the_proposed_ones(
    page: VirtualPage, bench: VirtualBench, proposal: dict[str, Any]
):
    assert proposal["percent_from_model"] == pytest.approx(100 * (LOOP.hz / MODEL_HZ - 1), abs=0.1)
    assert proposal["after"]["settling_ms"] < proposal["before"]["settling_ms"]
    assert proposal["tick"] is None
    assert taps(bench) == []
    status, swap = page.json("POST", "/api/swap?as=ada", swap_body(proposal))
    assert (status, swap["tick"] > 0) == (200, True), swap
    assert taps(bench) == proposal["prefilter"]["taps"]
    status, refusal = page.json("POST", "/api/swap?as=ada", swap_body(proposal))
    assert (status, "changed since the proposal" in refusal["error"]) == (409, True), refusal


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("response", QUICK_REQUEST | {"duration_s": 30.0}),
        ("learn", LEARN | {"cycles": 50, "keep": True}),
        ("retune", RETUNE),
    ],
)
def test_a_measurement_ends_with_its_page(page: VirtualPage, bench: VirtualBench, path: str, body: dict[str, Any]):
    before = taps(bench)
    begin_s = bench.turns.now_s
    has_moved = lambda: bench.newest("x_reference_um") != SETPOINT_UM
    page.request("POST", f"/api/{path}?as=ada", body, is_gone=has_moved)
    assert bench.turns.now_s - begin_s < END_S
    assert bench.status()["measuring"] is None
    assert reference_um(bench) == SETPOINT_UM
    tick = bench.ticks
    bench.wait_for(lambda: bench.ticks > tick + 4 * TICKS, "ticks")
    assert reference_um(bench) == SETPOINT_UM
    assert taps(bench) == before
    status, refusal = page.json("POST", f"/api/{path}?as=ada", body | {"axis": "z"})
    assert (status, "z" in refusal["error"]) in ((422, True), (409, True)), refusal


@pytest.mark.parametrize(
    ("path", "body", "code", "words"),
    [
        ("response", {"axis": "x", "amplitude_um": 0.0}, 422, "amplitude_um"),
        ("retune", {"axis": "x", "amplitude_um": -1.0}, 422, "amplitude_um"),
        ("retune", {"axis": "x", "spec": "/etc/passwd"}, 422, "spec"),
        ("retune", {"axis": "--help"}, 422, "axis: '--help' is unknown; allowed: x"),
        ("retune", {"axis": "\0"}, 422, "axis: '\\x00' is unknown; allowed: x"),
        ("swap", {"axis": "x", "replaces": {"taps": [1.0], "command_taps": []}}, 422, "command_taps"),
        ("learn", {"axis": "x", "samples": [99.0] * 8}, 422, "reaches a magnitude of 99 µm; allowed"),
    ],
)
def test_a_refusal_names_the_reason(
    page: VirtualPage, bench: VirtualBench, path: str, body: dict[str, Any], code: int, words: str
):
    status, response = page.json("POST", f"/api/{path}?as=ada", body)
    assert (status, words in response["error"]) == (code, True), response
    assert reference_um(bench) == SETPOINT_UM


def test_measurements_are_refused_while_another_client_drives(
    page: VirtualPage, bench: VirtualBench, proposal: dict[str, Any]
):
    before = taps(bench)
    bob = Client(bench.client.path, "bob")
    page.request("DELETE", "/api/lock?as=ada")
    bob.lock()
    for path, body in (("response", QUICK_REQUEST), ("learn", LEARN), ("retune", RETUNE)):
        status, refusal = page.json("POST", f"/api/{path}?as=ada", body)
        assert (status, "bob has held the lock since" in refusal["error"]) == (409, True), refusal
    unchanged = swap_body(proposal) | ({"replaces": proposal["prefilter"]} if before else {})
    status, refusal = page.json("POST", "/api/swap?as=ada", unchanged)
    assert (status, "bob has held the lock since" in refusal["error"]) == (409, True), refusal
    status, refusal = page.json("POST", "/api/retune?as=-rf", RETUNE)
    assert (status, "as: " in refusal["error"]) == (422, True), refusal
    assert taps(bench) == before
    bob.delete("/lock")
