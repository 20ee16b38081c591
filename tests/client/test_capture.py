"""Captures of a running loop hold the requested ticks, about the right tick, and replay identically."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest

import rtloop
from rtloop.client.capture.tick_capture import capture_ticks, current_run
from rtloop.client.connection import Connection
from rtloop.errors import RtloopError, UnavailableError
from rtloop.recording.load import Recording
from rtloop.recording.replay.replay import replay
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for

NOTEBOOK = Path(__file__).parents[2] / "docs" / "notebooks" / "live.ipynb"
Loop = tuple[Bench, Connection]


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Loop]:
    """In closed loop, recorded into a new file every two seconds."""
    recording = ("[recording]", "[recording]\nrotate_s = 2.0")
    with Bench(tmp_path_factory.mktemp("capture"), recording) as bench:
        bench.await_drive()
        yield bench, rtloop.connect(bench.client.path, as_="ada")


def asked(run: Recording) -> dict[str, np.ndarray]:
    """The ticks and references of the stretch that was asked for, once the whole replays."""
    report = replay(run)
    assert (report.identical, report.gaps, run.problems) == (True, [], [])
    said, tick = run.header["cut"], run["tick"]
    there = (tick >= said["first"]) & (tick < said["end"])
    assert tick[there].tolist() == list(range(said["first"], said["end"]))
    return {"tick": tick[there], "x_reference_um": run["x_reference_um"][there]}


def test_a_capture_about_a_tick_spans_changes_of_gains_and_modes(loop: Loop):
    bench, connection = loop
    connection.setpoint("x", 2.0)
    connection.mode("feedforward")
    tick = connection.setpoint("x", 12.5)
    connection.start()
    connection.tune("x", "controller", gain=0.011)
    stretch = asked(connection.capture(0.5, at=tick, pre_percent=20))
    place = int(np.flatnonzero(stretch["tick"] == tick)[0])
    rate_hz = bench.client.get("/configuration")["rate_hz"]
    assert len(stretch["tick"]) == round(0.5 * rate_hz)
    assert place == round((len(stretch["tick"]) - 1) * 0.2)
    assert stretch["x_reference_um"][place - 1 : place + 1].tolist() == [2.0, 12.5]


def test_changes_of_a_running_loop_are_previewed_made_and_undone(loop: Loop):
    _, connection = loop
    controller = lambda: connection.configuration["values"]["axis"][0]["controller"]
    before = controller()
    connection.preview("x", "controller", gain=0.012)
    assert controller() == before
    tick = connection.tune("x", "controller", gain=0.012)
    assert controller()["gain"] == 0.012
    assert connection.undo("x")["tick"] > tick
    assert controller() == before
    assert connection.controller("x", before | {"gain": 0.013}) > tick
    assert controller()["gain"] == 0.013
    connection.undo("x")
    connection.setpoint("x", 12.0)
    connection.waveform("x", np.linspace(12.0, 13.0, 50), hold_ticks=4)
    wait_for(lambda: connection.status["axes"]["x"]["reference_um"] == 13.0, "the last sample")
    assert next(connection.watch())["state"] == "running"
    assert "rtloop_" in connection.metrics


@pytest.mark.parametrize("pre_percent", [0, 30, 100])
def test_a_capture_about_a_trigger_has_it_at_its_place(loop: Loop, pre_percent: int):
    _, connection = loop
    connection.setpoint("x", 1.0)
    moves: list[int] = []
    mover = threading.Timer(0.3, lambda: moves.append(connection.setpoint("x", 6.0)))
    mover.start()
    edge = rtloop.Edge("x_reference_um", 3.0, "rising")
    stretch = asked(connection.capture(0.05, edge, pre_percent=pre_percent))
    mover.join()
    crossed = np.flatnonzero(stretch["tick"] == moves[0])
    assert crossed.tolist() == [round((len(stretch["tick"]) - 1) * pre_percent / 100)]


def test_a_capture_without_a_tick_begins_now(loop: Loop, tmp_path: Path):
    bench, connection = loop
    before = bench.ticks
    run = connection.capture(0.1, folder=tmp_path)
    assert [path.parent for path in run.paths] == [tmp_path]
    assert asked(run)["tick"][0] >= before


def test_a_capture_lies_beside_the_recording_and_overwrites_none(loop: Loop):
    bench, connection = loop
    tick = bench.ticks
    paths = [connection.capture(0.01, at=tick, pre_percent=0).paths[0] for _ in range(3)]
    stem = current_run(bench.client).file.stem
    assert [path.name for path in paths] == [f"{stem}.capture-{tick}{more}.mcap" for more in ("", "-2", "-3")]
    assert len({b"".join(rows.tobytes() for rows in rtloop.load(path).blocks()) for path in paths}) == 1
    assert rtloop.load(paths[0]).header["cut"]["files"][0].startswith(stem)


def test_a_capture_begins_at_tick_0_at_the_earliest(loop: Loop):
    """It reads no later file: the recorder gives the newest one another name every two seconds."""
    _, connection = loop
    run = connection.capture(0.02, at=0)
    assert asked(run)["tick"][0] == 0
    assert len(run.header["cut"]["files"]) == 1


def test_a_capture_in_a_separate_process_prints_its_report(loop: Loop):
    bench, _ = loop
    run = current_run(bench.client)
    command = [sys.executable, "-m", "rtloop.client.capture.tick_capture", bench.client.path, run.file]
    for first, ends in ((run.tick, ["identical"]), (1 << 40, [])):
        done = subprocess.run(
            [*map(str, command), str(first), str(first + 20) if ends else "7"], capture_output=True, text=True
        )
        said = json.loads(done.stdout)
        assert (done.returncode, [said[key] for key in said if key == "replay"]) == (not ends, ends), done


def test_invalid_captures_raise_and_leave_no_file(loop: Loop):
    bench, connection = loop
    before = sorted((bench.folder / "recordings").glob("*capture*"))
    for arguments, words in (
        ({"seconds": 0.0}, "capture seconds: 0.0; allowed: finite"),
        ({"seconds": float("nan")}, "seconds: nan"),
        ({"seconds": 1.0, "pre_percent": 101.0}, "pre_percent: 101"),
        ({"seconds": 1.0, "at": 5, "trigger": rtloop.Late()}, "both a trigger and `at` are given"),
        ({"seconds": 1.0, "timeout_s": -1.0}, "timeout_s: -1"),
        ({"seconds": 1.0, "trigger": rtloop.Edge("q_um", 0.0)}, "source: 'q_um'; allowed: tick, "),
    ):
        with pytest.raises(ValueError, match=words):
            connection.capture(**arguments)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"slope: 'up'; allowed: rising, falling, either"):
        rtloop.Edge("x_position_um", 0.0, "up")
    with pytest.raises(RtloopError, match=r"no trigger within 0\.2 s"):
        connection.capture(0.1, rtloop.Tripped(), timeout_s=0.2)
    with pytest.raises(RtloopError, match=r"reaches tick 1000000000 in \d+\.\d s; allowed: within timeout_s = 60 s"):
        connection.capture(0.1, at=10**9)
    assert sorted((bench.folder / "recordings").glob("*capture*")) == before


def test_a_capture_of_a_tick_ahead_comes_within_its_time(loop: Loop):
    """Half a second ahead at a known rate: refused within 0.1 s, captured within 60 s."""
    bench, connection = loop
    tick = bench.ticks + round(0.5 * bench.client.get("/configuration")["rate_hz"])
    with pytest.raises(RtloopError, match=rf"reaches tick {tick} in 0\.\d s; allowed: within timeout_s = 0\.1 s"):
        connection.capture(0.02, at=tick, timeout_s=0.1)
    assert tick in asked(connection.capture(0.02, at=tick))["tick"]


def test_a_capture_across_two_recorders_replays(loop: Loop):
    """The stretch begins behind the place, and the last state of the law before it is in the dead one's file."""
    bench, connection = loop
    dead = bench.pid("recorder")
    os.kill(dead, signal.SIGKILL)
    wait_for(lambda: bench.pid("recorder") != dead, "another recorder")
    wait_for(lambda: bench.status()["recording"]["state"] == "recording", "ticks that are taken")
    for _ in range(3):
        run = connection.capture(0.1, at=bench.ticks)
        asked(run)
    assert run.paths[0].parent == bench.folder / "recordings"


def test_the_notebook_runs(loop: Loop, monkeypatch: pytest.MonkeyPatch):
    """Its cells in order, in one namespace, as a kernel executes them; pictures are drawn and not shown."""
    bench, connection = loop
    connection.release()
    monkeypatch.setattr("rtloop.supervision.paths.client_folders", lambda: [bench.client.path.parent])
    matplotlib.use("agg")
    notebook = json.loads(NOTEBOOK.read_text())
    assert (notebook["nbformat"], len({cell["id"] for cell in notebook["cells"]})) == (4, len(notebook["cells"]))
    names: dict[str, Any] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert (cell["outputs"], cell["execution_count"]) == ([], None)
            exec(compile("".join(cell["source"]), f"{NOTEBOOK}: {cell['id']}", "exec"), names)
    assert asked(names["step"])["x_reference_um"][[0, -1]].tolist() == [0.0, 12.5]
    assert abs(names["position"][-1] - 12.5) < 0.2
    assert asked(names["period"])["x_reference_um"].max() == pytest.approx(3.0, abs=0.01)
    assert len(names["upper"].lines) == 2
    said = connection.status
    assert (said["lock"], said["mode"]) == (None, "off")
    assert "notebook" in {event["who"] for event in names["step"].events}


class Unrecorded:
    """What a service says that cannot write."""

    path = Path("lab.sock")

    def __init__(self, **recording: Any) -> None:
        self.said = {"state": "running", "tick": 9, "rate_hz": 1e4, "recording": recording}

    def get(self, _: str) -> dict[str, Any]:
        return self.said


def test_a_capture_without_a_recording_is_refused():
    full = Unrecorded(state="not recording", reason="No space left on device", since_tick=7, file="a", written_ticks=7)
    for client, words in (
        (full, "not recorded from tick 7 on: No space left on device"),
        (Unrecorded(), "no loop is recorded now; the state of the service is running"),
    ):
        with pytest.raises(UnavailableError, match=words):
            Connection(client).capture(1.0)  # type: ignore[arg-type]


def test_a_capture_after_the_end_of_the_run_is_complete(loop: Loop):
    """Last in this file: the service ends. Its captures are no parts of its recording."""
    bench, _ = loop
    run = current_run(bench.client)
    bench.stop()
    report = capture_ticks(bench.client, run.file, run.tick - 50, run.tick)
    assert asked(rtloop.load(report["output"]))["tick"][-1] == run.tick - 1
    wait_for(lambda: not [*run.file.parent.glob("*.part")], "the end of the files")
    parts = replay(rtloop.load(str(run.file.with_name(f"{run.file.stem}-*.mcap"))))
    assert parts.identical
