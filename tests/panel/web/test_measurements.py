"""Measurements from the panel agree with the rig, and end when their page disconnects."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from rtloop.client import Client
from tests.design.measured_loops import compute_margins
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.panel.measurement_rig import MODEL_HZ, SCAN_UM, TICKS, make_configuration
from tests.panel.web.browser import Browser
from tests.service.test_response import LOOP, QUICK_REQUEST, SETPOINT_UM

CANCEL_TIMEOUT_S = 10.0
"""Time in which a measurement must end after its page has disconnected."""
LEARN = {"axis": "x", "samples": SCAN_UM.tolist(), "cycles": 3, "keep": False}
RETUNE = {"axis": "x", "within_percent": 0.0}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Yield the bench of the measurement rig, with its loop running."""
    folder = tmp_path_factory.mktemp("measurements")
    with Bench(folder, board=False, text=make_configuration(folder)) as bench:
        bench.await_state("running")
        yield bench


@pytest.fixture(scope="module")
def browser(bench: Bench) -> Browser:
    """Return a logged-in browser of the service's panel; the panel ends with the bench."""
    return Browser(bench).log_in()


@pytest.fixture(scope="module")
def proposal(browser: Browser) -> dict[str, Any]:
    """Return the proposal of a retuning of axis x."""
    status, proposal = browser.json("POST", "/api/retune?as=ada", RETUNE)
    assert status == 200, proposal
    return proposal


def reference_um(bench: Bench) -> float:
    """Return the present reference of axis x."""
    return bench.client.get("/status")["axes"]["x"]["reference_um"]


def taps(bench: Bench) -> list[float]:
    """Return the taps of the prefilter in force; none without a prefilter."""
    return bench.client.get("/configuration")["values"]["axis"][0].get("prefilter", {}).get("taps", [])


def swap_body(proposal: dict[str, Any]) -> dict[str, Any]:
    """Return the body of the request that swaps in the proposed prefilter."""
    return {"axis": "x", **{key: proposal[key] for key in ("replaces", "prefilter")}}


def test_measured_margins_agree_with_the_rig(browser: Browser, bench: Bench):
    status, result = browser.json("POST", "/api/response?as=ada", QUICK_REQUEST)
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


def test_learning_shows_its_progress_and_keeps_no_table_without_consent(browser: Browser, bench: Bench):
    responses: list[tuple[int, Any]] = []
    request = threading.Thread(target=lambda: responses.append(browser.json("POST", "/api/learn?as=ada", LEARN)))
    request.start()
    progress: list[dict[str, Any]] = []
    while request.is_alive():
        progress += [measuring] if (measuring := bench.status()["measuring"]) else []
    request.join()
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
    assert browser.json("POST", "/api/waveform?as=ada", table)[0] == 200
    wait_for(lambda: abs(reference_um(bench) - SETPOINT_UM) > 1.0, "the table that plays")
    assert browser.json("POST", "/api/setpoint?as=ada", {"axis": "x", "value": SETPOINT_UM})[0] == 200


def test_nothing_changes_before_consent_and_then_the_taps_are_the_proposed_ones(
    browser: Browser, bench: Bench, proposal: dict[str, Any]
):
    assert proposal["percent_from_model"] == pytest.approx(100 * (LOOP.hz / MODEL_HZ - 1), abs=0.1)
    assert proposal["after"]["settling_ms"] < proposal["before"]["settling_ms"]
    assert proposal["tick"] is None
    assert taps(bench) == []
    status, swap = browser.json("POST", "/api/swap?as=ada", swap_body(proposal))
    assert (status, swap["tick"] > 0) == (200, True), swap
    assert taps(bench) == proposal["prefilter"]["taps"]
    status, refusal = browser.json("POST", "/api/swap?as=ada", swap_body(proposal))
    assert (status, "changed since the proposal" in refusal["error"]) == (409, True), refusal


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("response", QUICK_REQUEST | {"duration_s": 30.0}),
        ("learn", LEARN | {"cycles": 50, "keep": True}),
        ("retune", RETUNE),
    ],
)
def test_a_measurement_ends_with_its_page(browser: Browser, bench: Bench, path: str, body: dict[str, Any]):
    before = taps(bench)
    data = json.dumps(body).encode()
    head = f"POST /api/{path}?as=ada HTTP/1.1\r\nHost: {browser.host}:{browser.port}\r\nOrigin: {browser.origin}\r\n"
    with socket.create_connection((browser.host, browser.port)) as page:
        page.sendall(
            f"{head}Authorization: Bearer {browser.session}\r\nContent-Length: {len(data)}\r\n\r\n".encode() + data
        )
        wait_for(lambda: reference_um(bench) != SETPOINT_UM, "a motion")
    wait_for(lambda: bench.status()["measuring"] is None, "the end of the measurement", CANCEL_TIMEOUT_S)
    assert reference_um(bench) == SETPOINT_UM
    tick = bench.ticks
    wait_for(lambda: bench.ticks > tick + 4 * TICKS, "ticks")
    assert reference_um(bench) == SETPOINT_UM
    assert taps(bench) == before
    status, refusal = browser.json("POST", f"/api/{path}?as=ada", body | {"axis": "z"})
    assert (status, "z" in refusal["error"]) in ((422, True), (409, True)), refusal


@pytest.mark.parametrize(
    ("path", "body", "code", "words"),
    [
        ("response", {"axis": "x", "amplitude_um": 0.0}, 422, "amplitude_um"),
        ("retune", {"axis": "x", "amplitude_um": -1.0}, 422, "amplitude_um"),
        ("retune", {"axis": "x", "spec": "/etc/passwd"}, 422, "spec"),
        ("retune", {"axis": "--help"}, 422, "axis: '--help' is unknown; allowed: x"),
        ("retune", {"axis": "\0"}, 422, "null byte"),
        ("swap", {"axis": "x", "replaces": {"taps": [1.0], "command_taps": []}}, 422, "command_taps"),
        ("learn", {"axis": "x", "samples": [99.0] * 8}, 422, "reaches a magnitude of 99 µm; allowed"),
    ],
)
def test_a_refusal_names_the_reason(
    browser: Browser, bench: Bench, path: str, body: dict[str, Any], code: int, words: str
):
    status, response = browser.json("POST", f"/api/{path}?as=ada", body)
    assert (status, words in response["error"]) == (code, True), response
    assert reference_um(bench) == SETPOINT_UM


def test_measurements_are_refused_while_another_client_drives(browser: Browser, bench: Bench, proposal: dict[str, Any]):
    before = taps(bench)
    bob = Client(bench.client.path, "bob")
    browser.request("DELETE", "/api/lock?as=ada")
    for path, body in (("response", QUICK_REQUEST), ("learn", LEARN), ("retune", RETUNE)):
        bob.lock()  # on a busy host the requests together may last longer than the lock
        status, refusal = browser.json("POST", f"/api/{path}?as=ada", body)
        assert (status, "bob has held the lock since" in refusal["error"]) == (409, True), refusal
    unchanged = swap_body(proposal) | {"replaces": proposal["prefilter"]}
    bob.lock()
    status, refusal = browser.json("POST", "/api/swap?as=ada", unchanged)
    assert (status, "bob has held the lock since" in refusal["error"]) == (409, True), refusal
    status, refusal = browser.json("POST", "/api/retune?as=-rf", RETUNE)
    assert (status, "as: " in refusal["error"]) == (422, True), refusal
    assert taps(bench) == before
    bob.delete("/lock")
