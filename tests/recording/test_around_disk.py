"""A disk that fails while something happens: what is worth keeping waits, and is there once it can be written."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest

from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.summary import summarise
from tests.recording.around import AFTER_S, BEFORE_S, SECOND, TRIP, Selected, around
from tests.recording.disk import Disk


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    """Good until a test says otherwise."""
    return Disk(monkeypatch)


@pytest.mark.parametrize("full_from", [8_000, 9_500])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_nothing_around_a_trip_is_lost_while_the_disk_is_full(disk: Disk, tmp_path: Path, full_from: int, number: int):
    run = Selected(tmp_path / "run.mcap", around("trip"), paced=True)
    run.run_to(full_from)
    disk.error = number
    run.run_to(2 * SECOND + 7_000)
    disk.error = None
    run.run_to(8 * SECOND)
    totals = run.session.finish("finished")
    assert len(totals["paths"]) == 2
    assert totals["error"] is not None
    assert not totals["complete"]
    recording = load(totals["paths"])
    wanted = np.arange(max(TRIP - round(BEFORE_S * SECOND), 0), TRIP + round(AFTER_S * SECOND))
    assert np.isin(wanted, recording["tick"]).all()
    assert totals["ticks_lost"] == totals["events_lost"] == 0
    summary, report = summarise(totals["paths"]), replay(recording)
    assert (summary.ticks_lost, summary.complete) == (0, False)  # for it was not recorded for a while, and says so
    assert (report.identical, report.gaps) == (True, [])
    kinds = [event["kind"] for event in recording.events]
    assert [kind for kind in kinds if kind.startswith("recording_")] == ["recording_failed", "recording_resumed"]
    times = [event["time_ns"] for event in recording.events]
    assert times == sorted(times)


def test_what_the_memory_has_no_room_for_is_a_gap(disk: Disk, tmp_path: Path):
    said = around("trip") | {"after_s": 0.5}
    run = Selected(tmp_path / "run.mcap", said, paced=True)
    run.run_to(8_500)
    disk.error = errno.ENOSPC
    run.run_to(9 * SECOND + 100)
    disk.error = None
    run.run_to(14 * SECOND)
    totals = run.session.finish("finished")
    recording, summary = load(totals["paths"]), summarise(totals["paths"])
    gaps = [event["what"] for event in recording.events if event["kind"] == "gap"]
    assert summary.ticks_lost == totals["ticks_lost"] == sum(gap["count"] for gap in gaps) > 0
    report = replay(recording)
    assert report.gaps == gaps
    assert (report.identical, report.ticks + report.skipped + summary.ticks_lost) == (True, 14 * SECOND)
    assert sum(event["kind"] == "tripped" for event in recording.events) == 1


def test_a_file_that_is_begun_anew_begins_with_what_is_kept(disk: Disk, tmp_path: Path):
    run = Selected(tmp_path / "run.mcap", around("trip"), paced=True)
    run.run_to(12 * SECOND)
    disk.error = errno.ENOSPC  # in which an overview of ten seconds cannot be written
    run.run_to(16 * SECOND)
    disk.error = None
    run.run_to(18 * SECOND)
    totals = run.session.finish("finished")
    second = load(totals["paths"][1])
    assert second["tick"][0] % SECOND == 0
    assert replay(second).identical
    assert totals["ticks_lost"] == 0
