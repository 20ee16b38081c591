"""A replay in spans, one process each, gives the report of a replay in one process, for good and bad recordings."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtloop.recording.load import load
from rtloop.recording.replay import spans
from rtloop.recording.replay.laws import NO_TRUST, recorded_laws
from rtloop.recording.replay.replay import replay
from tests.command_line import answer
from tests.laws.test_shipped import DEPLOY
from tests.recording.forging import TICKS, Base, pack_changed_snapshot, pack_file, take_apart
from tests.recording.real_loop import eventful_configuration, record
from tests.recording.tamper import flip_byte
from tests.recording.test_verdict import change_ticks, drop_chunks, drop_snapshots, pack_with_gap, tick_chunks


@pytest.fixture(autouse=True)
def shorten_spans(monkeypatch: pytest.MonkeyPatch) -> None:
    """Allow spans of one chunk: the recordings of this file have six chunks."""
    monkeypatch.setattr(spans, "LEAST_CHUNKS", 1)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


def reports(path: Path) -> list[dict[str, Any]]:
    """Return the reports of a replay with one, two and five processes."""
    return [replay(load(path)).as_dict(), *(spans.replay_on_cores(load(path), jobs=n).as_dict() for n in (2, 5))]


def span_report(paths: Path | list[Path], jobs: int) -> dict[str, Any] | None:
    """Return the report of a replay in spans alone; None if the spans leave the replay to one process."""
    recording = load(paths)
    report = spans._replay_in_spans(recording, recorded_laws(recording, NO_TRUST), jobs, None)
    return report and report.as_dict()


@pytest.mark.parametrize("jobs", [2, 3, 4, 6])
def test_a_good_recording_is_identical_in_spans(jobs: int, base: Base, path: Path):
    path.write_bytes(pack_file(base))
    report = span_report(path, jobs)
    assert report == replay(load(path)).as_dict()
    assert (report["identical"], report["ticks"], report["snapshots_compared"]) == (True, TICKS, 4)


def test_a_run_of_whole_seconds_is_replayed_in_spans(tmp_path: Path):
    """The loop stores a last snapshot behind its last tick."""
    path = Path(answer("run", DEPLOY / "paper.toml", "--duration", "3", "--unpaced", "--out", tmp_path)["recording"])
    with closing(load(path).snapshots()) as snapshots:
        assert [snapshot.tick for snapshot in snapshots] == [0, 10_000, 20_000, 30_000]
    report = span_report(path, 3)
    assert report == replay(load(path)).as_dict()
    assert (report["identical"], report["ticks"], report["snapshots_compared"]) == (True, 30_000, 2)


@pytest.fixture(scope="module")
def rotated(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Four files of one run, each of which begins at a snapshot."""
    return record(tmp_path_factory.mktemp("rotated") / "run.mcap", eventful_configuration(), 35_000, rotate_s=1.0)


@pytest.mark.parametrize("jobs", [2, 3, 7])
def test_a_rotated_run_is_replayed_in_spans(jobs: int, rotated: list[Path]):
    assert len(rotated) == 4
    report = span_report(rotated, jobs)
    assert report == replay(load(rotated)).as_dict()
    assert (report["identical"], report["ticks"], report["snapshots_compared"]) == (True, 35_000, 3)


@pytest.mark.parametrize("missing", range(4))
def test_a_rotated_run_without_a_file_gets_the_answer_of_one_piece(missing: int, rotated: list[Path]):
    paths = [path for number, path in enumerate(rotated) if number != missing]
    assert span_report(paths, 3) is None
    assert spans.replay_on_cores(load(paths), jobs=3).as_dict() == replay(load(paths)).as_dict()


def test_a_changed_output_is_found_in_any_file_of_a_rotated_run(rotated: list[Path], tmp_path: Path):
    for number, path in enumerate(rotated):
        copies = [tmp_path / source_path.name for source_path in rotated]
        for source, copy in zip(rotated, copies, strict=True):
            copy.write_bytes(source.read_bytes())
        base = take_apart(path)

        def change_drive(records: np.ndarray) -> None:
            records["x_drive_v"][records["tick"] % 10_000 == 4_321] += 1e-9

        copies[number].write_bytes(pack_file(change_ticks(base, change_drive)))
        report = spans.replay_on_cores(load(copies), jobs=3).as_dict()
        assert report == replay(load(copies)).as_dict()
        assert report["first_difference"]["tick"] == 10_000 * number + 4_321


@pytest.mark.parametrize("which", [3, 4])
def test_a_snapshot_after_the_end_is_left_to_one_piece(which: int, base: Base, path: Path):
    path.write_bytes(pack_changed_snapshot(base, "tick", 4_000, which))
    single, *in_spans = reports(path)
    assert not single["identical"]
    assert all(report == single for report in in_spans)


def test_spans_begin_at_snapshots_and_cover_every_tick(base: Base, path: Path):
    """Snapshots: of ticks 0, 150, 200 (another law), 350 and 500; six chunks of a hundred ticks."""
    path.write_bytes(pack_file(base))
    found_spans = spans._find_spans(load(path), 3, [0, 150, 200, 350, 500])
    first, second, third = (0, 0), (2, 200), (5, 500)
    assert found_spans == [(first, second), (second, third), (third, None)]


def test_a_short_recording_is_replayed_in_one_piece(base: Base, path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(spans, "LEAST_CHUNKS", 8)
    path.write_bytes(pack_file(base))
    assert spans._find_spans(load(path), 8, [0, 150, 200, 350, 500]) == []
    assert span_report(path, 8) is None
    single, *in_spans = reports(path)
    assert all(report == single for report in in_spans)


@pytest.mark.parametrize("tick", [0, 199, 200, 350, 599])
def test_a_changed_output_is_found_at_its_tick_in_any_span(tick: int, base: Base, path: Path):
    def change_drive(records: np.ndarray) -> None:
        records["x_drive_v"][records["tick"] == tick] += 1e-9

    path.write_bytes(pack_file(change_ticks(base, change_drive)))
    single, *in_spans = reports(path)
    assert single["first_difference"]["tick"] == tick
    assert all(report == single for report in in_spans)
    assert span_report(path, 3) is None


@pytest.mark.parametrize("which", [1, 2, 3, 4])
def test_a_changed_state_is_found_in_any_snapshot(which: int, base: Base, path: Path):
    path.write_bytes(pack_changed_snapshot(base, "x.applied_command_um", 1e-3, which))
    single, *in_spans = reports(path)
    assert not single["identical"]
    assert all(report == single for report in in_spans)


def test_incomplete_and_damaged_recordings_get_the_answer_of_one_piece(base: Base, path: Path):
    chunks = tick_chunks(base)
    for data in (
        pack_file(drop_chunks(base, chunks[3])),
        pack_file(drop_chunks(base, len(base.chunks) - 1)),
        pack_file(drop_snapshots(base, {0})),
        pack_file(drop_snapshots(base, {2})),
        pack_with_gap(base, (3, 4), {"first_tick": 300, "count": 200}),
    ):
        path.write_bytes(data)
        single, *in_spans = reports(path)
        assert all(report == single for report in in_spans)
    path.write_bytes(pack_file(base))
    flip_byte(path, path.stat().st_size // 2)
    single, *in_spans = reports(path)
    assert not single["identical"]
    assert all(report == single for report in in_spans)


def test_a_process_that_dies_costs_time_and_no_answer(base: Base, path: Path, monkeypatch: pytest.MonkeyPatch):
    path.write_bytes(pack_file(base))
    parent, replay_span = os.getpid(), spans._replay_span
    monkeypatch.setattr(
        spans, "_replay_span", lambda *arguments: replay_span(*arguments) if os.getpid() == parent else os._exit(9)
    )
    assert span_report(path, 3) is None
    assert spans.replay_on_cores(load(path), jobs=3).identical


def test_the_command_answers_alike_for_any_number_of_jobs(base: Base, path: Path):
    path.write_bytes(pack_file(base))
    assert answer("replay", path, "--jobs", "1") == answer("replay", path, "--jobs", "4") == answer("replay", path)
