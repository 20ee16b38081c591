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

pytestmark = pytest.mark.system

NOTEBOOK = Path(__file__).parents[2] / "docs" / "notebooks" / "live.ipynb"
Loop = tuple[Bench, Connection]


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Loop]:
    """Yield a bench whose loop is closed and recorded into a new file every two seconds, and a connection as ada."""
    recording = ("[recording]", "[recording]\nrotate_s = 2.0")
    with Bench(tmp_path_factory.mktemp("capture"), recording) as bench:
        bench.await_drive()
        yield bench, rtloop.connect(bench.client.path, as_="ada")


def requested_rows(capture: Recording) -> dict[str, np.ndarray]:
    """Return the requested ticks of a capture and their references (µm); check that the whole capture replays."""
    report = replay(capture)
    assert (report.identical, report.gaps, capture.problems) == (True, [], [])
    cut, tick = capture.header["cut"], capture["tick"]
    is_requested = (tick >= cut["first"]) & (tick < cut["end"])
    assert tick[is_requested].tolist() == list(range(cut["first"], cut["end"]))
    return {"tick": tick[is_requested], "x_reference_um": capture["x_reference_um"][is_requested]}


def test_a_capture_about_a_tick_spans_changes_of_gains_and_modes(loop: Loop):
    bench, connection = loop
    connection.setpoint("x", 2.0)
    connection.mode("feedforward")
    tick = connection.setpoint("x", 12.5)
    connection.start()
    connection.tune("x", "controller", gain=0.011)
    rows = requested_rows(connection.capture(0.5, at=tick, pre_percent=20))
    index = int(np.flatnonzero(rows["tick"] == tick)[0])
    rate_hz = bench.client.get("/configuration")["rate_hz"]
    assert len(rows["tick"]) == round(0.5 * rate_hz)
    assert index == round((len(rows["tick"]) - 1) * 0.2)
    assert rows["x_reference_um"][index - 1 : index + 1].tolist() == [2.0, 12.5]


def test_changes_of_a_running_loop_are_previewed_made_and_undone(loop: Loop):
    _, connection = loop
    read_controller = lambda: connection.configuration["values"]["axis"][0]["controller"]
    before = read_controller()
    connection.preview("x", "controller", gain=0.012)
    assert read_controller() == before
    tick = connection.tune("x", "controller", gain=0.012)
    assert read_controller()["gain"] == 0.012
    assert connection.undo("x")["tick"] > tick
    assert read_controller() == before
    assert connection.controller("x", before | {"gain": 0.013}) > tick
    assert read_controller()["gain"] == 0.013
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
    rows = requested_rows(connection.capture(0.05, edge, pre_percent=pre_percent))
    mover.join()
    crossed = np.flatnonzero(rows["tick"] == moves[0])
    assert crossed.tolist() == [round((len(rows["tick"]) - 1) * pre_percent / 100)]


def test_a_capture_without_a_tick_begins_now(loop: Loop, tmp_path: Path):
    bench, connection = loop
    before = bench.ticks
    capture = connection.capture(0.1, folder=tmp_path)
    assert [path.parent for path in capture.paths] == [tmp_path]
    assert requested_rows(capture)["tick"][0] >= before


def test_a_capture_lies_beside_the_recording_and_overwrites_none(loop: Loop):
    bench, connection = loop
    tick = bench.ticks
    paths = [connection.capture(0.01, at=tick, pre_percent=0).paths[0] for _ in range(3)]
    stem = current_run(bench.client).file.stem
    assert [path.name for path in paths] == [f"{stem}.capture-{tick}{suffix}.mcap" for suffix in ("", "-2", "-3")]
    assert len({b"".join(rows.tobytes() for rows in rtloop.load(path).blocks()) for path in paths}) == 1
    assert rtloop.load(paths[0]).header["cut"]["files"][0].startswith(stem)


def test_a_capture_begins_at_tick_0_at_the_earliest(loop: Loop):
    """The capture reads the first file alone: the recorder renames the newest file every two seconds."""
    _, connection = loop
    capture = connection.capture(0.02, at=0)
    assert requested_rows(capture)["tick"][0] == 0
    assert len(capture.header["cut"]["files"]) == 1


def test_a_capture_in_a_separate_process_prints_its_report(loop: Loop):
    bench, _ = loop
    run = current_run(bench.client)
    command = [sys.executable, "-m", "rtloop.client.capture.tick_capture", bench.client.path, run.file]
    for first, expected in ((run.tick, ["identical"]), (1 << 40, [])):
        result = subprocess.run(
            [*map(str, command), str(first), str(first + 20) if expected else "7"], capture_output=True, text=True
        )
        report = json.loads(result.stdout)
        verdicts = [report[key] for key in report if key == "replay"]
        assert (result.returncode, verdicts) == (not expected, expected), result


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
    """A tick half a second ahead is refused with a time-out of 0.1 s and captured with the default of 60 s."""
    bench, connection = loop
    tick = bench.ticks + round(0.5 * bench.client.get("/configuration")["rate_hz"])
    with pytest.raises(RtloopError, match=rf"reaches tick {tick} in 0\.\d s; allowed: within timeout_s = 0\.1 s"):
        connection.capture(0.02, at=tick, timeout_s=0.1)
    assert tick in requested_rows(connection.capture(0.02, at=tick))["tick"]


def test_a_capture_across_two_recorders_replays(loop: Loop):
    """A capture after the death of a recorder replays, though it needs a snapshot from the file of that recorder."""
    bench, connection = loop
    dead_pid = bench.pid("recorder")
    os.kill(dead_pid, signal.SIGKILL)
    wait_for(lambda: bench.pid("recorder") != dead_pid, "another recorder")
    wait_for(lambda: bench.status()["recording"]["state"] == "recording", "a recording by the new recorder")
    for _ in range(3):
        run = connection.capture(0.1, at=bench.ticks)
        requested_rows(run)
    assert run.paths[0].parent == bench.folder / "recordings"


def test_the_notebook_runs(loop: Loop, monkeypatch: pytest.MonkeyPatch):
    """Execute the notebook's cells in order in one namespace, as a kernel does; figures are drawn and not shown."""
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
    assert requested_rows(names["step"])["x_reference_um"][[0, -1]].tolist() == [0.0, 12.5]
    assert abs(names["position"][-1] - 12.5) < 0.2
    assert requested_rows(names["period"])["x_reference_um"].max() == pytest.approx(3.0, abs=0.01)
    assert len(names["upper"].lines) == 2
    status = connection.status
    assert (status["lock"], status["mode"]) == (None, "off")
    assert "notebook" in {event["who"] for event in names["step"].events}


class ClientOfUnrecordedLoop:
    """Client of a service whose loop runs unrecorded; `recording` is the value of this key in its status."""

    path = Path("lab.sock")

    def __init__(self, **recording: Any) -> None:
        self.status = {"state": "running", "tick": 9, "rate_hz": 1e4, "recording": recording}

    def get(self, _: str) -> dict[str, Any]:
        return self.status


def test_a_capture_without_a_recording_is_refused():
    full_disk = ClientOfUnrecordedLoop(
        state="not recording", reason="No space left on device", since_tick=7, file="a", written_ticks=7
    )
    for client, words in (
        (full_disk, "not recorded from tick 7 on: No space left on device"),
        (ClientOfUnrecordedLoop(), "no loop is recorded now; the state of the service is running"),
    ):
        with pytest.raises(UnavailableError, match=words):
            Connection(client).capture(1.0)  # type: ignore[arg-type]


def test_a_capture_after_the_end_of_the_run_is_complete(loop: Loop):
    """This test is the last of the file, for it stops the service. Captures do not count as files of the recording."""
    bench, _ = loop
    run = current_run(bench.client)
    bench.stop()
    report = capture_ticks(bench.client, run.file, run.tick - 50, run.tick)
    assert requested_rows(rtloop.load(report["output"]))["tick"][-1] == run.tick - 1
    wait_for(lambda: not [*run.file.parent.glob("*.part")], "the end of the recording")
    verdict = replay(rtloop.load(str(run.file.with_name(f"{run.file.stem}-*.mcap"))))
    assert verdict.identical
