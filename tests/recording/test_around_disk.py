"""A disk that fails during an event: ticks worth recording wait until they can be written."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest

from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.summary import summarise
from tests.recording.around import AFTER_S, BEFORE_S, SECOND, TRIP, SelectiveRun, around_settings
from tests.recording.disk import PLENTY_BYTES, Disk
from tests.recording.test_disk import event_details, run_with_failing_disk


@pytest.mark.parametrize("first", [8_000, 9_500])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_no_tick_around_a_trip_is_lost_while_the_disk_is_full(disk: Disk, tmp_path: Path, first: int, number: int):
    run = SelectiveRun(tmp_path / "run.mcap", around_settings("trip"), paced=True)
    run_with_failing_disk(run, disk, number, first, 2 * SECOND + 7_000)
    totals = run.end(8 * SECOND)
    assert (len(totals["paths"]), totals["complete"], totals["ticks_lost"], totals["events_lost"]) == (2, False, 0, 0)
    assert totals["error"] is not None
    recording, summary = load(totals["paths"]), summarise(totals["paths"])
    expected = np.arange(max(TRIP - round(BEFORE_S * SECOND), 0), TRIP + round(AFTER_S * SECOND))
    assert np.isin(expected, recording["tick"]).all()
    report = replay(recording)
    assert (summary.ticks_lost, summary.complete) == (0, False)  # Recording paused for a while.
    assert (report.identical, report.gaps) == (True, [])
    kinds = [event["kind"] for event in recording.events if event["kind"].startswith("recording_")]
    assert kinds == ["recording_failed", "recording_resumed"]
    times = [event["time_ns"] for event in recording.events]
    assert times == sorted(times)


def test_ticks_beyond_the_limit_of_the_buffer_are_a_gap(disk: Disk, tmp_path: Path):
    run = SelectiveRun(tmp_path / "run.mcap", around_settings("trip", after_s=0.5), paced=True)
    run_with_failing_disk(run, disk, errno.ENOSPC, 8_500, 9 * SECOND + 100)
    totals = run.end(14 * SECOND)
    recording, summary = load(totals["paths"]), summarise(totals["paths"])
    gaps, report = event_details(recording.events, "gap"), replay(recording)
    assert summary.ticks_lost == totals["ticks_lost"] == sum(gap["count"] for gap in gaps) > 0
    assert (report.gaps, report.identical) == (gaps, True)
    assert report.ticks + report.skipped + summary.ticks_lost == 14 * SECOND
    assert len(event_details(recording.events, "tripped")) == 1


def test_a_file_that_is_begun_after_a_failure_begins_with_retained_ticks(disk: Disk, tmp_path: Path):
    run = SelectiveRun(tmp_path / "run.mcap", around_settings("trip"), paced=True)
    # An overview of ten seconds cannot be written meanwhile.
    run_with_failing_disk(run, disk, errno.ENOSPC, 12 * SECOND, 16 * SECOND)
    totals = run.end(18 * SECOND)
    second = load(totals["paths"][1])
    assert (second["tick"][0] % SECOND, replay(second).identical, totals["ticks_lost"]) == (0, True, 0)


def test_an_overview_stays_recorded_if_the_ticks_after_it_find_no_room(disk: Disk, tmp_path: Path):
    """The disk then has room for the overview of ten seconds, and for no chunk of ticks."""
    run = SelectiveRun(tmp_path / "run.mcap", around_settings("trip"), paced=True)
    run_with_failing_disk(run, disk, errno.ENOSPC, 12 * SECOND, 16 * SECOND)
    disk.longest_write_bytes = 60_000
    run.run_to(17 * SECOND)
    disk.longest_write_bytes = PLENTY_BYTES
    totals = run.end(20 * SECOND)
    recording, summary = load(totals["paths"]), summarise(totals["paths"])
    gaps, report = event_details(recording.events, "gap"), replay(recording)
    assert totals["ticks_lost"] == summary.ticks_lost == sum(gap["count"] for gap in gaps)
    assert (report.identical, report.gaps) == (True, gaps)
    assert report.ticks + report.skipped + totals["ticks_lost"] == 20 * SECOND
    overview_only = load(totals["paths"][1])
    assert (len(overview_only), overview_only.skipped) == (0, [(3 * SECOND, 10 * SECOND)])
