"""A recovery on real processes: the board stops and continues; the recording shows the drive.

The loop has no slew limit, and the ramp of a trip is slow: only the ramp of the return keeps the output slow. All
causes and policies are in `make faults` (tests/faults/recovery.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import rtloop
from rtloop.recording.replay.replay import replay
from tests.faults.bench import Bench
from tests.faults.recovery import QUICK, await_recovered, board_sleeps, narrow, stays_safe

pytestmark = pytest.mark.system

RATE_HZ, TRIP_SLEW_V_PER_S = 4000.0, 100.0
LEVELS_UM, DWELL_TICKS = [15.0, 25.0], 8000
CHANGES = (
    ("sample_age_us = 400000.0", "sample_age_us = 150000.0"),
    ("\nslew_v_per_s = 500.0", ""),
    ("trip_slew_v_per_s = 500.0", f"trip_slew_v_per_s = {TRIP_SLEW_V_PER_S}"),
    ('"sine"\namplitude = 8.0\noffset = 20.0\nfrequency_hz = 5.0', '"hold"\nvalue = 20.0'),
    ("frozen_ticks = 2000", "frozen_ticks = 0"),
    ("noise_um = 0.010\nresolution_um = 0.010", "noise_um = 0.0\nresolution_um = 0.0"),
    ("[recording]", f"[service.recover]\n{QUICK}[recording]"),
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Yield recording and last status of a service: its board stopped and continued while a client's waveform played,
    and its position interlock tripped afterwards.
    """
    with Bench(tmp_path_factory.mktemp("recover"), *CHANGES) as bench:
        bench.await_drive()
        waveform = {"axis": "x", "samples": LEVELS_UM, "hold_ticks": DWELL_TICKS, "repeat": True}
        bench.client.post("/waveform", waveform)
        board_sleeps(bench)
        await_recovered(bench)
        narrow("position_um", 5.0, "position")(bench)
        stays_safe(bench, 0.7)
        status = bench.status()
        assert bench.stop() == 0
        (path,) = (bench.folder / "recordings").glob("*.mcap")
        yield rtloop.load(path), status


def recovery_ticks(recording: Any) -> dict[str, int]:
    """Return the tick of each step of the recovery; of a repeated step the last one."""
    return {event["what"]["step"]: event["tick"] for event in recording.events if event["kind"] == "recovery"}


def test_the_output_returns_within_the_ramp_of_a_trip(run):
    """After a stall of loop or board, the position jumps and the controller responds: 10 ms are left out."""
    recording, _ = run
    steps = recovery_ticks(recording)
    span = slice(steps["confirmed"], steps["recovered"])
    drive_v, missed, age_us = (
        np.asarray(recording[name])[span] for name in ("x_drive_v", "periods_missed", "sample_age_us")
    )
    has_stalled = (missed > 0) | (age_us * 1e-6 * RATE_HZ > 2.0)
    is_judged = np.convolve(has_stalled, np.ones(round(0.01 * RATE_HZ)))[: has_stalled.size] == 0
    assert np.mean(is_judged) > 0.5
    resolution_v = 20.0 / 65536 * 10.0  # The converter's steps of the position, and the controller's response to them.
    assert drive_v[0] == 0.0
    assert drive_v[-1] > 1.0
    assert np.max(np.abs(np.diff(drive_v))[is_judged[1:]]) <= TRIP_SLEW_V_PER_S / RATE_HZ + resolution_v


def test_the_reference_of_the_client_plays_from_its_beginning(run):
    recording, _ = run
    reference_um = np.asarray(recording["x_reference_um"])
    assert reference_um[recovery_ticks(recording)["recovered"]] == LEVELS_UM[0]
    settings = [event for event in recording.events if event["kind"] == "set_reference"]
    (first,) = [
        event for event in settings if event["who"] == "operator" and event["what"]["values"][2] == len(LEVELS_UM)
    ]
    last = settings[-1]
    assert (last["who"], last["what"]["values"][2:4]) == ("supervisor", first["what"]["values"][2:4])


def test_each_step_is_an_event_of_the_loop_in_order(run):
    recording, _ = run
    recoveries = [event for event in recording.events if event["kind"] == "recovery"]
    assert {event["who"] for event in recoveries} == {"supervisor"}
    assert list(dict.fromkeys(event["what"]["step"] for event in recoveries if event["what"]["step"] != "unsound")) == [
        "begun", "confirmed", "returning", "recovered", "latched",
    ]  # fmt: skip
    assert recoveries[0]["what"]["causes"] == ["stale"]
    commands = {event["kind"]: event["tick"] for event in recording.events if event["who"] == "supervisor"}
    steps = recovery_ticks(recording)
    assert steps["confirmed"] <= commands["reset_trip"] <= steps["returning"]


def test_a_recording_with_a_recovery_replays_in_equal_bytes(run):
    recording, _ = run
    verdict = replay(recording)
    assert verdict.identical
    assert verdict.problems == []


def test_a_trip_by_position_stays_latched_and_says_why(run):
    _, status = run
    assert (status["state"], status["trip"]) == ("tripped", ["position"])
    recovery = status["recovery"]
    assert (recovery["state"], recovery["left"], recovery["causes"]) == ("latched", 2, ["position"])
    assert "service.recover.causes" in recovery["reason"]
