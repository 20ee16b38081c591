"""A disk that fails while a loop runs, and comes back: recording goes on, and every tick is accounted for."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtloop.engine.memory import ProcessState, Word
from rtloop.errors import OutputError
from rtloop.recording.capture.session import Options, Session
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.recover import recover
from rtloop.recording.file.topics.format import chunk_rows
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.summary import summarise
from tests.recording.disk import Disk, Recorded, missing
from tests.recording.hand_made_loop import HandMadeLoop, RecorderProcess, make_header, make_rows

SECOND = 10_000
"""Ticks between two snapshots."""
MIB = 1 << 20
COMMANDS = Counter([3_000, 5_000, 7_000, 7_400, 9_000, 14_000, 14_001, 14_001])
"""Ticks of the schedule's commands."""


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    """Good until a test says otherwise."""
    return Disk(monkeypatch)


def of_kind(events: list[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    return [event["what"] for event in events if event["kind"] == kind]


def check(totals: dict[str, Any], executed: int, *, gaps: int = 1, replayed: bool = True) -> list[dict[str, Any]]:
    """Every tick is in the files or in a gap that is said, and each file replays by itself; the gaps."""
    recording = load(totals["paths"])
    ticks = recording["tick"]
    lost = missing(ticks, executed)
    said = of_kind(recording.events, "gap")
    assert said == lost
    assert len(lost) == gaps
    assert totals["ticks_logged"] == len(ticks)
    assert totals["ticks_lost"] == sum(gap["count"] for gap in lost) == executed - len(ticks)
    assert not totals["complete"]
    summary = summarise(totals["paths"])
    assert (summary.ticks_lost, summary.complete) == (totals["ticks_lost"], False)
    for path in totals["paths"]:
        with Reader(path) as reader:
            assert reader.problems == []
            first = next(reader.blocks())[0, 0]
            assert next(reader.snapshots()).tick == first
            times = [
                message.log_time for _, messages in reader.chunks() for message in messages if message.channel == 2
            ]
            assert times == sorted(times)
        if replayed:
            part = load(path)
            verdict = replay(part)
            assert (verdict.identical, verdict.unverified) == (True, 0)
            assert verdict.gaps == of_kind(part.events, "gap")
    return lost


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO, errno.EROFS])
def test_goes_on_in_a_new_file_at_the_next_snapshot(disk: Disk, tmp_path: Path, number: int):
    run = Recorded(tmp_path / "run.mcap")
    run.run_to(6_000)
    disk.error = number
    run.run_to(13_000)  # one snapshot comes in vain
    disk.error = None
    run.run_to(35_000)
    totals = run.end()
    assert [Path(path).name for path in totals["paths"]] == ["run.mcap", "run-0002.mcap"]
    (gap,) = check(totals, 35_000)
    assert 0 < gap["first_tick"] < 13_000
    assert gap["first_tick"] + gap["count"] == 2 * SECOND
    assert os.strerror(number) in totals["error"]
    events = load(totals["paths"]).events
    (failed,), (resumed,) = of_kind(events, "recording_failed"), of_kind(events, "recording_resumed")
    assert os.strerror(number) in failed["error"]
    assert resumed == gap
    assert totals["events_lost"] == 0
    assert Counter(event["tick"] for event in events if event["who"] == "schedule") == COMMANDS
    verdict = replay(load(totals["paths"]))
    assert (verdict.identical, verdict.ticks, verdict.unverified) == (True, totals["ticks_logged"], 0)


def test_fails_and_goes_on_as_often_as_the_disk_does(disk: Disk, tmp_path: Path):
    run = Recorded(tmp_path / "run.mcap", rotate_s=3.0)
    for tick in range(15_000, 120_000, 30_000):
        run.run_to(tick)
        disk.error = errno.ENOSPC
        run.run_to(tick + 8_000)
        disk.error = None
    run.run_to(140_000)
    totals = run.end()
    check(totals, 140_000, gaps=4)
    assert load(totals["paths"]).problems == []


def test_a_folder_that_was_removed_and_made_again(disk: Disk, tmp_path: Path):
    folder = tmp_path / "recordings"
    folder.mkdir()
    run = Recorded(folder / "run.mcap")
    run.run_to(16_000)
    shutil.rmtree(folder)
    run.run_to(32_000)
    folder.mkdir()
    run.run_to(55_000)
    totals = run.end()
    assert check(totals, 55_000) == [{"first_tick": 0, "count": 4 * SECOND}]
    assert "removed" in totals["error"]
    assert os.listdir(folder) == ["run-0002.mcap"]


def test_a_folder_that_stays_away(disk: Disk, tmp_path: Path):
    folder = tmp_path / "recordings"
    folder.mkdir()
    run = Recorded(folder / "run.mcap")
    run.run_to(16_000)
    shutil.rmtree(folder)
    run.run_to(32_000)
    totals = run.end()
    assert (totals["ticks_logged"], totals["ticks_lost"], totals["complete"]) == (0, 32_000, False)


def test_a_file_that_was_removed_to_make_room_frees_it(disk: Disk, tmp_path: Path):
    run = Recorded(tmp_path / "run.mcap")
    run.run_to(16_000)
    disk.error = errno.ENOSPC
    run.run_to(24_000)
    os.remove(tmp_path / "run.mcap.part")
    run.run_to(33_000)
    held = [os.readlink(link) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    assert not [name for name in held if name.startswith(str(tmp_path / "run.mcap.part"))]
    disk.error = None
    run.run_to(55_000)
    assert check(run.end(), 55_000) == [{"first_tick": 0, "count": 4 * SECOND}]


def test_too_little_free_space_and_enough_again(disk: Disk, tmp_path: Path):
    run = Recorded(tmp_path / "run.mcap", min_free_bytes=64 * MIB)
    run.run_to(6_000)
    disk.free_bytes = 64 * MIB - 1
    run.run_to(15_000)
    disk.free_bytes = 64 * MIB + 4096  # it would be over at once
    run.run_to(25_000)
    disk.free_bytes = 128 * MIB
    run.run_to(45_000)
    totals = run.end()
    (gap,) = check(totals, 45_000)
    assert gap["first_tick"] + gap["count"] == 3 * SECOND
    assert "to stay free" in totals["error"]


def test_no_file_without_ticks_is_left(disk: Disk, tmp_path: Path):
    run = Recorded(tmp_path / "run.mcap")
    run.run_to(6_000)
    disk.longest_write_bytes = 40_000  # enough for a file's beginning, not for ticks
    run.run_to(45_000)
    disk.longest_write_bytes = 1 << 40
    run.run_to(65_000)
    totals = run.end()
    check(totals, 65_000)
    assert sorted(os.listdir(tmp_path)) == ["run-0002.mcap", "run.mcap"]
    events = load(totals["paths"]).events
    assert Counter(event["tick"] for event in events if event["who"] == "schedule") == COMMANDS


def test_no_inode_for_the_next_part(disk: Disk, tmp_path: Path):
    run = Recorded(tmp_path / "run.mcap", rotate_s=1.0)
    run.run_to(6_000)
    disk.inodes = False
    run.run_to(25_000)
    disk.inodes = True
    run.run_to(45_000)
    totals = run.end()
    assert check(totals, 45_000) == [{"first_tick": SECOND, "count": 2 * SECOND}]
    assert load(totals["paths"]).problems == []


def test_an_unpaced_run_is_not_tried_again(disk: Disk, tmp_path: Path):
    run = Recorded(tmp_path / "run.mcap", paced=False)
    run.run_to(6_000)
    disk.error = errno.ENOSPC
    run.run_to(13_000)
    disk.error = None
    run.run_to(35_000)
    totals = run.end()
    assert [Path(path).name for path in totals["paths"]] == ["run.mcap"]
    assert totals["ticks_lost"] == 35_000 - totals["ticks_logged"] > 20_000
    assert "No space left" in totals["error"]


def test_a_recorder_in_place_of_one_that_died_waits_for_room(disk: Disk, tmp_path: Path):
    run = Recorded(tmp_path / "run.mcap")
    run.run_to(6_000)
    disk.error = errno.ENOSPC
    run.run_to(13_000)
    run.begin(sequence=2)
    run.run_to(25_000)
    disk.error = None
    run.run_to(45_000)
    totals = run.end()
    assert [Path(path).name for path in totals["paths"]] == ["run-0002.mcap"]
    assert totals["ticks_logged"] + totals["ticks_lost"] == 45_000
    (second,) = totals["paths"]
    written = chunk_rows(run.header["columns"])  # by the first one
    assert totals["ticks_logged"] == len(load(second)["tick"]) + written
    assert of_kind(load(second).events, "gap") == [{"first_tick": written, "count": 3 * SECOND - written}]


def test_a_disk_that_fails_for_good_takes_nothing_back(disk: Disk, tmp_path: Path):
    run = Recorded(tmp_path / "run.mcap")
    run.run_to(16_000)
    disk.error = errno.EIO
    run.run_to(32_000)
    totals = run.end()
    part = tmp_path / "run.mcap.part"
    disk.error = None
    assert recover(part)["ticks"] == totals["ticks_logged"] >= 10_000
    assert totals["ticks_lost"] == 32_000 - totals["ticks_logged"]


def test_a_run_that_cannot_begin_leaves_nothing(disk: Disk, tmp_path: Path):
    loop = HandMadeLoop()
    disk.error = errno.ENOSPC
    with pytest.raises(OutputError, match="No space left"):
        Session(loop.block, tmp_path / "run.mcap", make_header(), Options(min_free_bytes=0))
    assert os.listdir(tmp_path) == []


def not_brought_to_the_disk() -> None:
    """What a failed fsync says, once."""
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def test_a_file_that_may_not_be_on_the_disk_is_not_counted_and_named(disk: Disk, tmp_path: Path):
    """The system says so once, and may have given up what it could not write."""
    run = Recorded(tmp_path / "run.mcap", rotate_s=1.0)
    run.run_to(15_000)
    disk.at_fsync = not_brought_to_the_disk
    said = []
    while run.loop.tick < 25_000:
        run.run_to(run.loop.tick + 1_000)
        said.append(run.loop.block.load(Word.RECORDER_FAILURE))
    totals = run.end()
    part = tmp_path / "run-0002.mcap.part"
    assert (totals["ticks_logged"], totals["ticks_lost"], totals["complete"]) == (15_000, SECOND, False)
    assert str(part) in totals["error"]
    assert [Path(path).name for path in totals["paths"]] == ["run-0001.mcap", "run-0003.mcap"]
    assert (errno.EIO in said, said[0], said[-1]) == (True, 0, 0)
    assert run.loop.block.load(Word.LOST_TICKS) == SECOND
    (failed,) = of_kind(load(totals["paths"][-1]).events, "recording_failed")
    assert str(part) in failed["error"]
    found = load([totals["paths"][0], recover(part)["output"], totals["paths"][1]])  # it is still there, as it happens
    assert (replay(found).identical, len(found)) == (True, 25_000)


def test_the_last_file_of_a_run_may_not_be_on_the_disk(disk: Disk, tmp_path: Path):
    run = Recorded(tmp_path / "run.mcap")
    run.run_to(15_000)
    disk.at_fsync = not_brought_to_the_disk
    totals = run.end()
    assert (totals["paths"], totals["ticks_logged"], totals["ticks_lost"]) == ([], 0, 15_000)
    assert f"{tmp_path / 'run.mcap.part'}: {os.strerror(errno.EIO)}" in totals["error"]


@pytest.mark.parametrize(("stall_ticks", "lost"), [(8 * SECOND, False), (15 * SECOND, True)])
def test_a_disk_that_stands_still_at_a_rotation(disk: Disk, tmp_path: Path, stall_ticks: int, lost: bool):
    """What the ring holds meanwhile is recorded; what it does not hold is said."""
    run = Recorded(tmp_path / "run.mcap", rotate_s=1.0)
    run.run_to(5_000)
    disk.at_fsync = lambda: run.loop.run(stall_ticks)
    run.run_to(12_000)
    executed = run.loop.tick + 2 * SECOND
    run.run_to(executed)
    totals = run.end()
    recording = load(totals["paths"])
    assert missing(recording["tick"], executed) == of_kind(recording.events, "gap")
    assert (totals["ticks_lost"] > 0, totals["complete"]) == (lost, not lost)
    assert totals["ticks_logged"] + totals["ticks_lost"] == executed
    assert replay(recording).first_difference is None


def test_rotates_at_the_right_tick_however_far_the_loop_is_ahead(tmp_path: Path):
    loop, rows = HandMadeLoop(), make_rows(50_000)
    loop.run(rows, snapshot_every=4_000)  # all of it before the first tick is drained
    options = Options(min_free_bytes=0, rotate_s=1.0)
    session = Session(loop.block, tmp_path / "run.mcap", make_header(paced=False), options)
    while session.cursor < len(rows):
        session.drain()
        session.write_due()
    totals = session.finish("finished")
    assert totals["complete"]
    for path in totals["paths"]:
        with Reader(path) as reader:
            first = next(reader.blocks())[0, 0]
            assert first == reader.header["first_tick"] == next(reader.snapshots()).tick
            assert (reader.totals["complete"], reader.totals["ticks_lost"]) == (True, 0)
    assert np.concatenate(list(load(totals["paths"]).blocks())).tobytes() == rows.tobytes()


def test_a_small_disk_that_is_made_larger(tmp_path: Path):
    """The recorder's process: it says that it fails, goes on, and says that in the end."""
    small = tmp_path / "disk"
    small.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "none", small], capture_output=True).returncode:
        pytest.skip("mounting a small disk is not permitted here")
    loop = HandMadeLoop()
    recorder, rows, block = RecorderProcess(loop), make_rows(45_000), loop.block
    try:
        recorder.start(small / "run.mcap")
        loop.run(rows[:25_000], slack=20_000, snapshot_every=5_000)
        recorder.wait_until(lambda: block.load(Word.RECORDER_STATE) == ProcessState.FAILED)
        subprocess.run(["mount", "-o", "remount,size=64m", small], check=True)
        loop.run(rows[25_000:35_000], slack=20_000, snapshot_every=5_000)
        recorder.wait_until(lambda: block.load(Word.RECORDER_STATE) == ProcessState.RUNNING)
        loop.run(rows[35_000:], slack=20_000, snapshot_every=5_000)
        loop.end()
        code, totals = recorder.result()
        assert code == 1
        assert "No space left" in totals["error"]
        check(totals, len(rows), replayed=False)
        logged = np.concatenate(list(load(totals["paths"]).blocks()))
        assert logged.tobytes() == rows[logged[:, 0].astype(int)].tobytes()
    finally:
        recorder.process.kill()
        recorder.process.communicate()
        subprocess.run(["umount", small], check=True)
