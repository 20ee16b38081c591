"""A recording that is executed again gives the same bytes."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest

from rtloop.recording.file.recover import recover
from rtloop.recording.load import load
from rtloop.recording.replay.replay import ReplayReport, replay
from rtloop.signals import Flag
from tests.recording.conftest import EVENTFUL_TICKS
from tests.recording.hand_made_loop import RecorderProcess
from tests.recording.real_loop import TWO_AXES, RealLoop, eventful_configuration, record
from tests.service.test_run import eight_axis_text

ROTATED_TICKS = 45_000


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Files of the eventful run of ROTATED_TICKS ticks, one second each."""
    return record(tmp_path_factory.mktemp("parts") / "run.mcap", eventful_configuration(), ROTATED_TICKS, rotate_s=1.0)


def replay_without_difference(paths: Path | list[Path]) -> ReplayReport:
    """Replay files and require that no value differs. Returns the report."""
    report = replay(load(paths))
    assert report.first_difference is None
    return report


def test_saturation_trips_and_changes_of_mode_replay(eventful: Path):
    report, recording = replay_without_difference(eventful), load(eventful)
    assert (report.ticks, report.unverified, report.gaps, report.snapshots) == (EVENTFUL_TICKS, 0, [], 2)
    flags = int(np.bitwise_or.reduce(recording["flags"].astype(int)))
    for flag in (Flag.COMMAND_LIMITED, Flag.SLEW_LIMITED, Flag.RAMPING, Flag.TRIP_POSITION):
        assert flags & flag, flag
    assert set(recording["mode"]) == {0.0, 2.0, 3.0}
    assert {event["kind"] for event in recording.events} >= {"set_mode", "tripped", "reset_trip", "set_reference"}


@pytest.mark.parametrize(("text", "axes"), [(TWO_AXES, 2), (eight_axis_text(), 8)], ids=["two axes", "eight axes"])
def test_several_axes_replay(text: str, axes: int, tmp_path: Path):
    path = record(tmp_path / "run.mcap", text, 12_000)[0]
    report = replay_without_difference(path)
    assert (len(load(path).header["axes"]), report.ticks, report.snapshots) == (axes, 12_000, 1)


def test_the_files_of_a_rotated_recording_replay_together_and_alone(parts: list[Path]):
    assert len(parts) == 5
    report = replay_without_difference([parts[i] for i in (3, 0, 4, 2, 1)])
    assert (report.ticks, report.gaps, report.problems) == (ROTATED_TICKS, [], [])
    assert replay(load(str(parts[0].parent / "run-*.mcap"))).ticks == ROTATED_TICKS
    assert [replay_without_difference(part).ticks for part in parts] == [10_000] * 4 + [5_000]


@pytest.mark.parametrize(("number", "gaps"), [(0, []), (1, [{"first_tick": 10_000, "count": 10_000}])])
def test_a_rotated_recording_replays_without_one_of_its_files(
    parts: list[Path], number: int, gaps: list[dict[str, int]]
):
    report = replay_without_difference([part for part in parts if part != parts[number]])
    assert (report.ticks, report.gaps) == (35_000, gaps)
    assert report.problems == [f"file {number + 1} of the run is missing"]


def test_a_recovered_file_replays(eventful: Path, tmp_path: Path):
    part = tmp_path / "run.mcap.part"
    part.write_bytes(eventful.read_bytes()[: eventful.stat().st_size * 2 // 3])
    report = recover(part)
    assert 10_000 < report["ticks"] < EVENTFUL_TICKS
    assert replay_without_difference(Path(report["output"])).ticks == report["ticks"]


def test_the_replay_continues_after_a_gap_at_the_next_snapshot(tmp_path: Path):
    """The recorder is stopped for longer than the ring holds."""
    loop = RealLoop(eventful_configuration())
    with RecorderProcess(loop) as recorder:  # type: ignore[arg-type]
        recorder.start(tmp_path / "run.mcap", loop.header)
        loop.run(13_500)
        recorder.wait_for_ticks(13_500)
        recorder.process.send_signal(signal.SIGSTOP)
        loop.run(160_000)
        recorder.process.send_signal(signal.SIGCONT)
        recorder.wait_for_ticks(173_500)
        loop.run(14_200)
        loop.end()
        lost = recorder.result()[1]["ticks_lost"]
    assert lost > 20_000
    report = replay_without_difference(tmp_path / "run.mcap")
    assert (report.gaps, report.snapshots > 4) == ([{"first_tick": 13_500, "count": lost}], True)
    assert 0 < report.unverified < 10_000
    assert report.ticks + report.unverified + lost == 187_700
