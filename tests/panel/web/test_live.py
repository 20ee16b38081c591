"""Frames of a running service agree with the recording of the same ticks, and the panel changes no tick."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import numpy as np
import pytest

from rtloop import load
from tests.faults.account import account
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.panel.web.browser import Browser

pytestmark = pytest.mark.system

EDGE = {"mode": "normal", "kind": "edge", "source": "x_reference_um", "level": 20.0, "pre_percent": 25}
VIEW = {"signals": ["x_reference_um", "x_position_um", "tick"], "seconds": 0.05, "pixels": 1000, "trigger": EDGE}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Yield the bench of a running loop."""
    with Bench(tmp_path_factory.mktemp("live")) as bench:
        bench.await_drive()
        yield bench


@pytest.fixture(scope="module")
def browser(bench: Bench) -> Browser:
    """Return a logged-in browser of the service's panel."""
    return Browser(bench).log_in()


def test_the_page_receives_the_description_of_the_loop(bench: Bench, browser: Browser):
    status, description = browser.json("GET", "/api/panel")
    assert status == 200
    assert (description["name"], description["rate_hz"]) == ("lab", 4000.0)
    assert (description["axes"], description["longest_s"]) == (["x"], 60.0)
    assert description["defaults"]["limits"]["command_um"] == 42.0
    assert description["defaults"]["interlocks"]["position_um"] == 60.0
    by_name = {column["name"]: column for column in description["columns"]}
    assert (by_name["x_drive_v"]["unit"], by_name["lateness_us"]["unit"]) == ("V", "µs")
    assert "drive u" in by_name["x_drive_v"]["meaning"]
    assert browser.json("GET", "/api/status")[1]["state"] == "running"
    assert browser.json("GET", "/api/configuration")[1]["block"] == str(bench.folder / "run" / "lab.block")


def test_commands_are_forwarded(bench: Bench, browser: Browser):
    status, response = browser.json("POST", "/api/setpoint?as=ada", {"axis": "x", "value": 12.5})
    assert (status, set(response)) == (200, {"tick"})
    assert bench.status()["lock"]["name"] == "ada"
    status, refusal = browser.json("POST", "/api/setpoint?as=bob", {"axis": "x", "value": 12.5})
    assert status == 409
    assert "ada has held the lock" in refusal["error"]
    assert browser.json("POST", "/api/setpoint?as=ada", {"axis": "y", "value": 12.5})[0] == 422
    with browser.live() as live:
        names: dict[int, str] = {}
        while response["tick"] not in names:
            header, _ = browser.next_message(live, "events")
            names |= {event["tick"]: event["who"] for event in header["events"] if event["kind"] == "set_reference"}
        assert names[response["tick"]] == "ada"
    assert browser.json("DELETE", "/api/lock?as=ada")[0] == 200
    sine = {"kind": "sine", "amplitude": 8.0, "offset": 20.0, "frequency_hz": 5.0}
    assert browser.json("POST", "/api/reference", {"axis": "x", "reference": sine})[0] == 200


def test_sweeps_spectra_and_other_frames_agree_with_the_loop(browser: Browser):
    subscriptions = {
        "view": VIEW,
        "timing": True,
        "xy": {"axis": "x", "seconds": 1.0},
        "spectrum": {"signal": "x_position_um", "low_hz": 2.0, "high_hz": 20.0},
    }
    with browser.live(subscriptions) as live:
        state, _ = browser.next_message(live, "state")
        assert state["state"] == "running"
        sine = {"kind": "sine", "text": "sine of 8 µm at 5 Hz about 20 µm", "value": None}
        wait_for(lambda: browser.next_message(live, "state")[0]["references"] == {"x": sine}, "the reference set last")
        header, arrays = browser.next_message(live, "sweep")
        assert (header["cause"], header["complete"]) == ("trigger", True)
        offset, reference = arrays["offset"], arrays["x_reference_um:low"]
        assert offset[0] == header["first"] - header["trigger"] == -round(199 * 0.25)
        index = int(np.flatnonzero(offset == 0)[0])
        assert reference[index - 1] < 20.0 <= reference[index]
        assert np.array_equal(arrays["tick:low"].astype(int) - header["trigger"], offset.astype(int))
        xy, loop = browser.next_message(live, "xy")
        assert xy["axis"] == "x"
        assert 0 < len(loop["drive_v"]) <= 4000
        assert np.corrcoef(loop["model_position_um"], np.interp(
            np.arange(len(loop["model_drive_v"])), np.linspace(0, len(loop["model_drive_v"]), len(loop["position_um"])),
            loop["position_um"]))[0, 1] > 0.9  # fmt: skip
        timing, counted = browser.next_message(live, "timing")
        assert timing["ticks"] == counted["counts"].sum() > 0
        assert timing["p50_us"] <= timing["p99_us"] <= timing["worst_us"] * 1.1

        def is_of_the_sine() -> bool:
            """Whether the next spectrum reaches below 1 Hz and is of a sine of 8 µm, without the rest before it."""
            spectrum, bands = browser.next_message(live, "spectrum")
            reaches = len(bands["hz"]) > 0 and bands["hz"].min() < 1.0
            return reaches and spectrum["rms"] == pytest.approx(8000 / np.sqrt(2), rel=0.1)

        wait_for(is_of_the_sine, "a spectrum of the sine")
        status, figures = browser.json(
            "GET", f"/api/measure?run={header['run']}&first={header['first']}&end={header['end']}&signals=tick"
        )
        ticks = np.arange(header["first"], header["end"])
        assert status == 200
        assert figures["tick"] == pytest.approx(
            {"rms": np.sqrt(np.mean(ticks.astype(float) ** 2)), "mean": ticks.mean(), "std": ticks.std(),
             "low": ticks[0], "high": ticks[-1], "peak_to_peak": len(ticks) - 1})  # fmt: skip
    for query, code in (("run=9&first=0&end=1&signals=tick", 410), ("run=0&first=5&end=5&signals=tick", 422),
                        ("run=0&first=x&end=5&signals=tick", 422), ("run=0&first=0&end=999999999&signals=tick", 410),
                        (f"run=0&first={header['first']}&end={header['end']}&signals=no", 422)):  # fmt: skip
        assert browser.json("GET", f"/api/measure?{query}")[0] == code, query


def test_what_the_panel_does_changes_no_tick(bench: Bench, browser: Browser):
    """A second panel is stopped and killed while clients watch; then the service restarts under the first panel."""
    other_browser = Browser(bench).log_in()
    with browser.live({"view": VIEW}) as live, other_browser.live({"view": VIEW}) as other_live:
        other_browser.next_message(other_live, "sweep")
        other_browser.process.send_signal(signal.SIGSTOP)
        ticks = bench.ticks
        wait_for(lambda: bench.ticks > ticks + 2000, "ticks while a panel is stopped")
        other_browser.process.kill()
        other_browser.process.wait()
        sweeps = [browser.next_message(live, "sweep")[0] for _ in range(5)]
        run = sweeps[-1]["run"]
        assert bench.stop() == 0
        state = browser.next_message(live, "state")[0]
        while state["state"] != "unreachable":
            state = browser.next_message(live, "state")[0]
        assert state["error"]
        bench.start_service()
        bench.await_drive()
        header = browser.next_message(live, "sweep")[0]
        while header["run"] == run:
            header = browser.next_message(live, "sweep")[0]
        assert header["trigger"] < bench.ticks
        assert browser.next_message(live, "state")[0]["state"] == "running"
    browser.process.send_signal(signal.SIGTERM)
    assert browser.process.wait(30) == 0
    first, *_ = sorted((bench.folder / "recordings").glob("*.mcap"))
    recording = load(first)
    assert np.array_equal(recording["tick"], np.arange(len(recording)))
    reference = recording["x_reference_um"]
    for sweep in sweeps:
        assert reference[sweep["trigger"] - 1] < 20.0 <= reference[sweep["trigger"]]
    numbers = [sweep["number"] for sweep in sweeps]
    edges = 1 + np.flatnonzero((reference[:-1] < 20.0) & (reference[1:] >= 20.0))
    edge_numbers = [int(np.flatnonzero(edges == sweep["trigger"])[0]) for sweep in sweeps]
    assert np.diff(edge_numbers).tolist() == np.diff(numbers).tolist()  # The panel counts every edge as a sweep.
    assert bench.stop() == 0
    report = account(bench.folder / "recordings", bench.blocks)
    assert (report.problems, report.lost) == ([], 0)
