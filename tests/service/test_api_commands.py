"""Commands of the control API in virtual time: trips, modes, references and changes. The loop's events are evidence."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner

from rtloop.cli import main
from tests.service.http import GOOD_CONTROLLER
from tests.virtual.bench import VirtualBench


def test_a_trip_latches_until_the_reset(virtual: VirtualBench):
    tick = virtual.client.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 5.0}})["tick"]
    assert virtual.event("load_law", tick)["axis"] == "x"
    virtual.await_state("tripped")
    assert virtual.status()["trip"] == ["position"]
    for path, body in (("/start", {}), ("/arm", {}), ("/mode", {"mode": "feedforward"}), ("/response", {"axis": "x"})):
        code, response = virtual.answer("POST", path, body)
        assert (code, "`rtloop ctl reset`" in response["error"]) == (409, True), response
    for path, body in (("/stop", {}), ("/mode", {"mode": "off"}), ("/stop", {})):
        code, response = virtual.answer("POST", path, body)
        assert code == 200, response
        assert tick < response["tick"] <= virtual.ticks
    assert virtual.answer("GET", "/status")[1]["state"] == "tripped"
    virtual.client.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 60.0}})
    tick = virtual.client.post("/reset")["tick"]
    virtual.event("reset_trip", tick)
    assert virtual.client.get("/status")["state"] in ("stopped", "ramping")
    assert virtual.answer("POST", "/start")[0] == 409
    virtual.client.post("/arm")


def test_modes_and_references(virtual: VirtualBench):
    for reference in ({"kind": "hold", "value": 12.0}, {"kind": "triangle", "amplitude": 3.0, "frequency_hz": 2.0},
                      {"kind": "steps", "levels": [1.0, 2.0], "dwell_s": 0.1}):  # fmt: skip
        tick = virtual.client.post("/reference", {"axis": "x", "reference": reference})["tick"]
        virtual.event("set_reference", tick)
    virtual.client.post("/setpoint", {"axis": "x", "value": 11.0})
    assert virtual.client.get("/status")["axes"]["x"]["reference_um"] == 11.0
    virtual.client.post("/mode", {"mode": "feedforward"})
    assert virtual.client.get("/status")["mode"] == "feedforward"


def test_a_healthy_loop_is_not_reset(virtual: VirtualBench):
    code, response = virtual.answer("POST", "/reset")
    assert (code, "there is no trip; the state of the service is running" in response["error"]) == (409, True)
    assert virtual.client.get("/status")["mode"] == "closed_loop"


def test_into_raw_mode_and_out_of_it_what_is_in_force_is_held(virtual: VirtualBench):
    """A change of mode does not reuse 20 µm as 20 V, nor 6 V as 6 µm; the loop's records show the signals."""
    virtual.client.post("/setpoint", {"axis": "x", "value": 20.0})
    settled = virtual.ticks + 4000
    virtual.wait_for(lambda: virtual.ticks > settled, "20 µm")
    raw_tick = virtual.client.post("/mode", {"mode": "raw"})["tick"]
    for volts, expected_code in ((10.5, 422), (-10.5, 422), (6.0, 200)):
        code, response = virtual.answer("POST", "/setpoint", {"axis": "x", "value": volts})
        assert code == expected_code
        assert code == 200 or "references in mode raw are in V" in response["error"]
    settled = virtual.ticks + 4000
    virtual.wait_for(lambda: virtual.ticks > settled, "6 V")
    closed_tick = virtual.client.post("/mode", {"mode": "closed_loop"})["tick"]
    virtual.wait_for(lambda: virtual.ticks > closed_tick + 4000, "the loop closed")
    virtual.client.post("/stop")
    virtual.event("set_mode", closed_tick)
    reference, position, drive = (virtual.column(f"x_{name}") for name in ("reference_um", "position_um", "drive_v"))
    raw, closed = (tick - int(virtual.column("tick")[0]) for tick in (raw_tick, closed_tick))
    assert reference[raw - 1] == 20.0
    assert reference[raw] == drive[raw - 1]
    assert np.ptp(drive[raw - 1 : raw + 3]) < 1e-9
    assert reference[closed] == position[closed - 1]
    held = position[closed + 2000 : closed + 4000]
    assert abs(held.mean() - reference[closed]) < 0.1
    assert reference[closed] > 15.0  # µm, the position that 6 V have reached


def test_a_waveform_plays_once(virtual: VirtualBench):
    samples = (15.0 + 5.0 * np.sin(np.linspace(0.0, 2 * np.pi, 500))).tolist()
    tick = virtual.client.post("/waveform", {"axis": "x", "samples": samples, "hold_ticks": 2})["tick"]
    assert virtual.event("set_reference", tick)["what"]["values"][2:5] == [500.0, 2.0, 0.0]
    virtual.wait_for(lambda: virtual.ticks > tick + 1100, "the end of the waveform")
    assert virtual.client.get("/status")["axes"]["x"]["reference_um"] == samples[-1]


@pytest.mark.parametrize(("typed", "code"), [("-5", 0), ("-.5e1", 0), ("-50", 1), ("--nonsense", 2)])
def test_a_negative_number_is_no_option(virtual: VirtualBench, typed: str, code: int):
    result = CliRunner().invoke(main, ["ctl", "--socket", str(virtual.client.path), "setpoint", "x", typed])
    assert result.exit_code == code, result.output
    if code == 0:
        assert virtual.client.get("/status")["axes"]["x"]["reference_um"] == -5.0


def test_tune_and_swap(virtual: VirtualBench):
    for path, body in (
        ("/tune", {"axis": "x", "section": "controller", "values": {"gain": 0.012}}),
        ("/tune", {"axis": "x", "section": "limits", "values": {"command_um": 40.0}}),
        ("/controller", {"axis": "x", "controller": GOOD_CONTROLLER}),
    ):
        tick = virtual.client.post(path, body)["tick"]
        assert virtual.event("load_law", tick)["axis"] == "x"
    assert virtual.answer("POST", "/setpoint", {"axis": "x", "value": 41.0})[0] == 422
    assert virtual.client.get("/status")["state"] == "running"
    virtual.client.post("/reload")  # load the file again
    assert virtual.answer("POST", "/setpoint", {"axis": "x", "value": 20.0})[0] == 200


def test_reload(virtual: VirtualBench):
    valid_text = virtual.config.read_text()
    try:
        assert virtual.client.post("/reload") == {"changed": []}
        virtual.config.write_text(valid_text.replace("offset = 20.0", "offset = 18.0\nphase_deg = 90.0"))
        assert virtual.client.post("/reload") == {"changed": ["axis.x"]}
        offset = lambda: [event["what"]["values"][3] for event in virtual.events("set_reference")][-1]
        virtual.wait_for(lambda: offset() == 18.0, "a reference")
        for text, code, word in (
            (valid_text.replace("rate_hz = 4000", "rate_hz = 5000"), 409, "restart"),
            (valid_text.replace("gain = 0.016", "gain = 0.16"), 422, "unstable"),
            (valid_text + "[nonsense", 422, "TOML"),
        ):
            virtual.config.write_text(text)
            assert virtual.answer("POST", "/reload")[0] == code
            assert word in virtual.answer("POST", "/reload")[1]["error"]
    finally:
        virtual.config.write_text(valid_text)
    assert virtual.client.post("/reload") == {"changed": ["axis.x"]}
