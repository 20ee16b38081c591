"""A recording executed again gives the same bytes."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest

from rtloop.recording.file.recover import recover
from rtloop.recording.load import load
from rtloop.recording.replay.replay import ReplayReport, replay
from rtloop.signals import Flag
from tests.recording.hand_made_loop import RecorderProcess
from tests.recording.real_loop import TWO_AXES, RealLoop, record, scheduled
from tests.service.test_run import eight_axes

TICKS, SEVERAL = 25_000, 45_000


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in which everything happens, in one file."""
    return record(tmp_path_factory.mktemp("replay") / "run.mcap", scheduled(), TICKS)[0]


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The same, rotated."""
    return record(tmp_path_factory.mktemp("parts") / "run.mcap", scheduled(), SEVERAL, rotate_s=1.0)


def replayed(paths: Path | list[Path]) -> ReplayReport:
    report = replay(load(paths))
    assert report.first_difference is None
    return report


def test_saturation_trips_and_changes_of_mode(whole: Path):
    report = replayed(whole)
    assert (report.ticks, report.unverified, report.gaps) == (TICKS, 0, [])
    assert report.snapshots == 2
    rows = load(whole)
    seen = int(np.bitwise_or.reduce(rows["flags"].astype(int)))
    for flag in (Flag.COMMAND_LIMITED, Flag.SLEW_LIMITED, Flag.RAMPING, Flag.TRIP_POSITION):
        assert seen & flag, flag
    assert set(rows["mode"]) == {0.0, 2.0, 3.0}
    assert {event["kind"] for event in rows.events} >= {"set_mode", "tripped", "reset_trip", "set_reference"}


@pytest.mark.parametrize(("text", "axes"), [(TWO_AXES, 2), (eight_axes(), 8)], ids=["two axes", "eight axes"])
def test_several_axes(text: str, axes: int, tmp_path: Path):
    path = record(tmp_path / "run.mcap", text, 12_000)[0]
    assert len(load(path).header["axes"]) == axes
    report = replayed(path)
    assert (report.ticks, report.snapshots) == (12_000, 1)


def test_a_rotated_recording_is_one(parts: list[Path]):
    assert len(parts) == 5
    report = replayed([parts[i] for i in (3, 0, 4, 2, 1)])
    assert (report.ticks, report.gaps, report.problems) == (SEVERAL, [], [])
    pattern = replay(load(str(parts[0].parent / "run-*.mcap")))
    assert pattern.ticks == SEVERAL
    assert [replayed(part).ticks for part in parts] == [10_000] * 4 + [5_000]


def test_the_oldest_part_was_deleted(parts: list[Path]):
    report = replayed(parts[1:])
    assert (report.ticks, report.gaps) == (35_000, [])
    assert report.problems == ["part 1 of the run is missing"]


def test_a_part_in_the_middle_was_deleted(parts: list[Path]):
    report = replayed([parts[0], *parts[2:]])
    assert (report.ticks, report.gaps) == (35_000, [{"first_tick": 10_000, "count": 10_000}])


def test_a_recovered_file(whole: Path, tmp_path: Path):
    cut = tmp_path / "run.mcap.part"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
    report = recover(cut)
    assert 10_000 < report["ticks"] < TICKS
    assert replayed(Path(report["output"])).ticks == report["ticks"]


def test_a_gap_is_passed_by_the_next_snapshot_and_said(tmp_path: Path):
    """The recorder is stopped for longer than the ring holds."""
    loop = RealLoop(scheduled())
    recorder = RecorderProcess(loop)  # type: ignore[arg-type]
    try:
        recorder.start(tmp_path / "run.mcap", loop.header)
        loop.run(13_500)
        recorder.wait_until(lambda: _cursor(recorder) == 13_500)
        recorder.process.send_signal(signal.SIGSTOP)
        loop.run(160_000)
        recorder.process.send_signal(signal.SIGCONT)
        recorder.wait_until(lambda: _cursor(recorder) == 173_500)
        loop.run(14_200)
        loop.end()
        _, totals = recorder.result()
    finally:
        recorder.process.kill()
        recorder.process.communicate()
    lost = totals["ticks_lost"]
    assert lost > 20_000
    report = replayed(tmp_path / "run.mcap")
    assert report.gaps == [{"first_tick": 13_500, "count": lost}]
    assert 0 < report.unverified < 10_000
    assert report.ticks + report.unverified + lost == 187_700
    assert report.snapshots > 4


def _cursor(recorder: RecorderProcess) -> int:
    from rtloop.engine.memory import Word

    return recorder.loop.block.load(Word.RECORDER_CURSOR)
