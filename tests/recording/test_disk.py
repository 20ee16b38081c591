"""A disk that fails while a loop runs, and recovers: the recorder resumes, and every tick is accounted for."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from rtloop.engine.memory import ProcessState, Word
from rtloop.errors import OutputError
from rtloop.recording.capture.session import Options, Session
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.recover import recover
from rtloop.recording.file.topics.format import chunk_rows
from rtloop.recording.file.writer import Writer
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.summary import summarise
from rtloop.signals import Mode
from rtloop.supervision.recording_state import recording_state
from tests.recording.disk import PLENTY_BYTES, Disk, find_gaps
from tests.recording.hand_made_loop import START_UNIX_NS, HandMadeLoop, RecorderProcess, make_header, make_rows
from tests.recording.real_loop import RecordedRun, read_rows

SECOND = 10_000
"""Ticks between two snapshots."""
MIB = 1 << 20
COMMANDS = Counter([3_000, 5_000, 7_000, 7_400, 9_000, 14_000, 14_001, 14_001])
"""Ticks of the schedule's commands."""


@pytest.fixture
def run(disk: Disk, tmp_path: Path) -> RecordedRun:
    """A recorded run on a disk that works until a test makes it fail."""
    return RecordedRun(tmp_path / "run.mcap")


def event_details(events: list[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    """Return the details (`what`) of all events of a kind."""
    return [event["what"] for event in events if event["kind"] == kind]


def scheduled_ticks(events: list[dict[str, Any]]) -> Counter[int]:
    """Return the ticks of the events of the schedule, with their counts."""
    return Counter(event["tick"] for event in events if event["who"] == "schedule")


def file_names(totals: dict[str, Any]) -> list[str]:
    """Return the names of the finished files."""
    return [Path(path).name for path in totals["paths"]]


def run_with_failing_disk(run: RecordedRun, disk: Disk, number: int, first: int, end: int) -> None:
    """Run to tick `first`, then to tick `end` with a disk whose writes fail with the errno `number`."""
    run.run_to(first)
    disk.error = number
    run.run_to(end)
    disk.error = None


def require_every_tick_accounted(
    totals: dict[str, Any], executed: int, *, gaps: int = 1, replayed: bool = True
) -> list[dict[str, Any]]:
    """Require that each tick is in a file or in a gap event, and that each file replays alone. Returns the gaps."""
    recording, summary = load(totals["paths"]), summarise(totals["paths"])
    ticks = recording["tick"]
    lost = find_gaps(ticks, executed)
    assert (event_details(recording.events, "gap"), len(lost)) == (lost, gaps)
    count = sum(gap["count"] for gap in lost)
    assert (totals["ticks_logged"], totals["ticks_lost"], totals["complete"]) == (len(ticks), count, False)
    assert (count, summary.ticks_lost, summary.complete) == (executed - len(ticks), count, False)
    for path in totals["paths"]:
        with Reader(path) as reader:
            assert reader.problems == []
            assert next(reader.snapshots()).tick == next(reader.blocks())[0, 0]
            messages = [message for _, messages in reader.chunks() for message in messages]
            times = [message.log_time for message in messages if message.channel == 2]
            assert times == sorted(times)
        if replayed:
            part = load(path)
            verdict = replay(part)
            expected = (True, 0, event_details(part.events, "gap"))
            assert (verdict.identical, verdict.unverified, verdict.gaps) == expected
    return lost


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO, errno.EROFS])
def test_recording_resumes_in_a_new_file_at_the_next_snapshot(disk: Disk, run: RecordedRun, number: int):
    run_with_failing_disk(run, disk, number, 6_000, 13_000)  # The disk still fails at the snapshot of tick 10,000.
    totals = run.end(35_000)
    assert file_names(totals) == ["run.mcap", "run-0002.mcap"]
    (gap,) = require_every_tick_accounted(totals, 35_000)
    assert 0 < gap["first_tick"] < 13_000
    assert gap["first_tick"] + gap["count"] == 2 * SECOND
    events = load(totals["paths"]).events
    (failed,), resumed = event_details(events, "recording_failed"), event_details(events, "recording_resumed")
    assert all(os.strerror(number) in text for text in (totals["error"], failed["error"]))
    assert (resumed, totals["events_lost"], scheduled_ticks(events)) == ([gap], 0, COMMANDS)
    verdict = replay(load(totals["paths"]))
    assert (verdict.identical, verdict.ticks, verdict.unverified) == (True, totals["ticks_logged"], 0)


def test_recording_resumes_after_each_of_several_failures(disk: Disk, tmp_path: Path):
    run = RecordedRun(tmp_path / "run.mcap", rotate_s=3.0)
    for number, tick in zip([errno.ENOSPC, errno.EIO] * 2, range(15_000, 120_000, 30_000), strict=True):
        run_with_failing_disk(run, disk, number, tick, tick + 8_000)
    totals = run.end(140_000)
    assert os.strerror(errno.ENOSPC) in totals["error"]  # The first one is reported.
    require_every_tick_accounted(totals, 140_000, gaps=4)
    assert load(totals["paths"]).problems == []


@pytest.mark.parametrize("is_restored", [True, False])
def test_a_removed_folder_costs_its_ticks_until_it_is_restored(disk: Disk, tmp_path: Path, is_restored: bool):
    folder = tmp_path / "recordings"
    folder.mkdir()
    run = RecordedRun(folder / "run.mcap")
    run.run_to(16_000)
    shutil.rmtree(folder)
    run.run_to(32_000)
    if not is_restored:
        totals = run.end()
        assert (totals["ticks_logged"], totals["ticks_lost"], totals["complete"]) == (0, 32_000, False)
        return
    folder.mkdir()
    totals = run.end(55_000)
    assert require_every_tick_accounted(totals, 55_000) == [{"first_tick": 0, "count": 4 * SECOND}]
    assert ("removed" in totals["error"], os.listdir(folder)) == (True, ["run-0002.mcap"])


def test_a_removed_unfinished_file_is_closed_and_frees_its_space(disk: Disk, run: RecordedRun, tmp_path: Path):
    run.run_to(16_000)
    disk.error = errno.ENOSPC
    run.run_to(24_000)
    os.remove(tmp_path / "run.mcap.part")
    run.run_to(33_000)
    open_files = [os.readlink(link) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    assert not [name for name in open_files if name.startswith(str(tmp_path / "run.mcap.part"))]
    disk.error = None
    assert require_every_tick_accounted(run.end(55_000), 55_000) == [{"first_tick": 0, "count": 4 * SECOND}]


def test_recording_resumes_once_more_than_the_minimum_is_free(disk: Disk, tmp_path: Path):
    run = RecordedRun(tmp_path / "run.mcap", min_free_bytes=64 * MIB)
    run.run_to(6_000)
    for tick, free_bytes in ((15_000, 64 * MIB - 1), (25_000, 64 * MIB + 4096)):  # The latter would be full at once.
        disk.free_bytes = free_bytes
        run.run_to(tick)
    reason = recording_state(run.loop.block)["reason"]
    assert "1.25 times recording.min_free_mib plus 1 MiB are free" in reason  # The minimum itself is free.
    disk.free_bytes = 128 * MIB
    totals = run.end(45_000)
    (gap,) = require_every_tick_accounted(totals, 45_000)
    assert (gap["first_tick"] + gap["count"], "must stay free" in totals["error"]) == (3 * SECOND, True)


def test_a_file_without_ticks_is_removed(disk: Disk, run: RecordedRun, tmp_path: Path):
    run.run_to(6_000)
    disk.longest_write_bytes = 40_000  # Enough for the beginning of a file, not for ticks.
    run.run_to(45_000)
    disk.longest_write_bytes = PLENTY_BYTES
    totals = run.end(65_000)
    require_every_tick_accounted(totals, 65_000)
    assert sorted(os.listdir(tmp_path)) == ["run-0002.mcap", "run.mcap"]
    assert scheduled_ticks(load(totals["paths"]).events) == COMMANDS


def test_events_that_are_in_a_file_stay_where_no_tick_could_follow_them(disk: Disk, loop: HandMadeLoop, tmp_path: Path):
    session = Session(loop.block, tmp_path / "run.mcap", make_header(), Options(min_free_bytes=0))
    loop.command(0, Mode.FEEDFORWARD)
    session.drain()
    session._write_all()
    disk.longest_write_bytes = 40_000
    loop.run(make_rows(4_000))
    session.drain()
    session._write_all()
    disk.longest_write_bytes = PLENTY_BYTES
    totals = session.finish("finished")
    assert [event["kind"] for event in load(totals["paths"]).events][:1] == ["set_mode"]
    assert (totals["events_lost"], totals["ticks_lost"], totals["complete"]) == (0, 4_000, False)


def test_the_file_of_another_process_is_not_removed_with_an_own_one(tmp_path: Path):
    path = tmp_path / "run.mcap"
    writer = Writer(path, make_header(), START_UNIX_NS)
    writer.part.unlink()
    writer.part.write_text("another recording")
    writer.discard()
    assert writer.part.read_text() == "another recording"


def test_recording_resumes_after_a_rotation_without_a_free_inode(disk: Disk, tmp_path: Path):
    run = RecordedRun(tmp_path / "run.mcap", rotate_s=1.0)
    run.run_to(6_000)
    disk.inodes = False
    run.run_to(25_000)
    disk.inodes = True
    totals = run.end(45_000)
    assert require_every_tick_accounted(totals, 45_000) == [{"first_tick": SECOND, "count": 2 * SECOND}]
    assert load(totals["paths"]).problems == []


def test_an_unpaced_run_is_not_resumed(disk: Disk, tmp_path: Path):
    run = RecordedRun(tmp_path / "run.mcap", paced=False)
    run_with_failing_disk(run, disk, errno.ENOSPC, 36_000, 75_000)
    totals = run.end(110_000)
    assert totals["ticks_lost"] == 110_000 - totals["ticks_logged"] > 70_000
    assert (file_names(totals), "No space left" in totals["error"]) == (["run.mcap"], True)


def test_a_replacement_recorder_waits_for_room(disk: Disk, run: RecordedRun):
    run.run_to(6_000)
    disk.error = errno.ENOSPC
    run.run_to(13_000)
    run.begin(sequence=2)
    run.run_to(25_000)
    disk.error = None
    totals = run.end(45_000)
    assert (file_names(totals), totals["ticks_logged"] + totals["ticks_lost"]) == (["run-0002.mcap"], 45_000)
    second, written = load(totals["paths"]), chunk_rows(run.header["columns"])  # The dead recorder wrote one chunk.
    assert totals["ticks_logged"] == len(second) + written
    assert event_details(second.events, "gap") == [{"first_tick": written, "count": 3 * SECOND - written}]


def test_ticks_written_before_a_lasting_failure_are_counted(disk: Disk, run: RecordedRun, tmp_path: Path):
    run.run_to(16_000)
    disk.error = errno.EIO
    totals = run.end(32_000)
    disk.error = None
    assert recover(tmp_path / "run.mcap.part")["ticks"] == totals["ticks_logged"] >= 10_000
    assert totals["ticks_lost"] == 32_000 - totals["ticks_logged"]


def test_a_run_that_cannot_begin_leaves_no_file(disk: Disk, loop: HandMadeLoop, tmp_path: Path):
    disk.error = errno.ENOSPC
    with pytest.raises(OutputError, match="No space left"):
        Session(loop.block, tmp_path / "run.mcap", make_header(), Options(min_free_bytes=0))
    assert os.listdir(tmp_path) == []


def refuse_fsync() -> None:
    """Fail as an fsync whose data did not reach the disk."""
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def test_a_file_that_may_not_be_on_the_disk_is_not_counted_and_named(disk: Disk, tmp_path: Path):
    """The system reports a failed fsync once, and may have dropped the data."""
    run, part = RecordedRun(tmp_path / "run.mcap", rotate_s=1.0), tmp_path / "run-0002.mcap.part"
    run.run_to(15_000)
    disk.at_fsync = refuse_fsync
    failures = []
    for tick in range(16_000, 26_000, 1_000):
        run.run_to(tick)
        failures.append(run.loop.block.load(Word.RECORDER_FAILURE))
    totals = run.end()
    assert (totals["ticks_logged"], totals["ticks_lost"], totals["complete"]) == (15_000, SECOND, False)
    assert file_names(totals) == ["run-0001.mcap", "run-0003.mcap"]
    assert (errno.EIO in failures, failures[0], failures[-1]) == (True, 0, 0)
    assert run.loop.block.load(Word.LOST_TICKS) == SECOND
    (failed,) = event_details(load(totals["paths"][-1]).events, "recording_failed")
    assert all(str(part) in text for text in (totals["error"], failed["error"]))
    recording = load([totals["paths"][0], recover(part)["output"], totals["paths"][1]])  # Here the data is still there.
    assert (replay(recording).identical, len(recording)) == (True, 25_000)


def test_a_last_file_that_may_not_be_on_the_disk_is_not_counted(disk: Disk, run: RecordedRun, tmp_path: Path):
    run.run_to(15_000)
    disk.at_fsync = refuse_fsync
    totals = run.end()
    assert (totals["paths"], totals["ticks_logged"], totals["ticks_lost"]) == ([], 0, 15_000)
    assert f"{tmp_path / 'run.mcap.part'}: {os.strerror(errno.EIO)}" in totals["error"]


@pytest.mark.parametrize(("stall_ticks", "lost"), [(8 * SECOND, False), (15 * SECOND, True)])
def test_a_disk_that_stalls_at_a_rotation_loses_only_what_the_ring_cannot_hold(
    disk: Disk, tmp_path: Path, stall_ticks: int, lost: bool
):
    run = RecordedRun(tmp_path / "run.mcap", rotate_s=1.0)
    run.run_to(5_000)
    disk.at_fsync = lambda: run.loop.run(stall_ticks)
    run.run_to(12_000)
    executed = run.loop.tick + 2 * SECOND
    totals = run.end(executed)
    recording = load(totals["paths"])
    assert find_gaps(recording["tick"], executed) == event_details(recording.events, "gap")
    assert (totals["ticks_lost"] > 0, totals["complete"]) == (lost, not lost)
    assert totals["ticks_logged"] + totals["ticks_lost"] == executed
    assert replay(recording).first_difference is None


def test_rotation_is_at_the_right_tick_however_far_the_loop_is_ahead(loop: HandMadeLoop, tmp_path: Path):
    rows = make_rows(50_000)
    loop.run(rows, snapshot_every=4_000)  # All ticks are in the ring before the first is drained.
    options = Options(min_free_bytes=0, rotate_s=1.0)
    session = Session(loop.block, tmp_path / "run.mcap", make_header(paced=False), options)
    while session.cursor < len(rows):
        session.drain()
        session.write_due()
    totals = session.finish("finished")
    assert totals["complete"]
    for path in totals["paths"]:
        with Reader(path) as reader:
            assert next(reader.blocks())[0, 0] == reader.header["first_tick"] == next(reader.snapshots()).tick
            assert (reader.totals["complete"], reader.totals["ticks_lost"]) == (True, 0)
    assert read_rows(totals["paths"]).tobytes() == rows.tobytes()


def test_the_recorder_process_resumes_on_a_disk_that_was_enlarged(loop: HandMadeLoop, tmp_path: Path):
    """The recorder's state shows the failure, and its totals name the cause."""
    small, rows = tmp_path / "disk", make_rows(45_000)
    small.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "none", small], capture_output=True).returncode:
        pytest.skip("mounting a small disk is not permitted here")
    try:
        with RecorderProcess(loop) as recorder:
            recorder.start(small / "run.mcap")
            loop.run(rows[:25_000], slack=20_000, snapshot_every=5_000)
            recorder.wait_for_state(ProcessState.FAILED)
            subprocess.run(["mount", "-o", "remount,size=64m", small], check=True)
            loop.run(rows[25_000:35_000], slack=20_000, snapshot_every=5_000)
            recorder.wait_for_state(ProcessState.RUNNING)
            loop.run(rows[35_000:], slack=20_000, snapshot_every=5_000)
            code, totals = recorder.end()
        assert (code, "No space left" in totals["error"]) == (1, True)
        require_every_tick_accounted(totals, len(rows), replayed=False)
        logged = read_rows(totals["paths"])
        assert logged.tobytes() == rows[logged[:, 0].astype(int)].tobytes()
    finally:
        subprocess.run(["umount", small], check=True)
