"""A system call that fails once: no file claims more than it holds."""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rtloop.engine.memory import Word
from rtloop.errors import OutputError
from rtloop.recording.cutting.cut import cut, cut_path
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.mcap.chunkfile import ChunkFile
from rtloop.recording.file.recover import find_leftovers, recover
from rtloop.recording.file.writer import Writer
from rtloop.recording.load import load
from rtloop.recording.views.summary import summarise
from rtloop.supervision.recorder_keeper import RecorderKeeper
from tests.recording.disk import Disk
from tests.recording.hand_made_loop import START_UNIX_NS, make_header, make_rows, write_recording
from tests.recording.real_loop import RecordedRun

TICKS, PART_BYTES = 3_000, 100
SECOND = 10_000


@pytest.fixture
def part(tmp_path: Path) -> Path:
    """The unfinished file of a recorder that was killed while it wrote the index."""
    part = tmp_path / "killed.mcap.part"
    part.write_bytes(write_recording(tmp_path / "run.mcap", make_rows(TICKS)).read_bytes()[:-PART_BYTES])
    return part


@pytest.fixture
def keeper() -> RecorderKeeper:
    """Stand-in for a RecorderKeeper: the notes that its methods write."""
    return cast(RecorderKeeper, SimpleNamespace(notes=[]))


def refuse(*_: object, **__: object) -> Any:
    """Raise the OSError EIO, in place of a system call."""
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def refuse_the_end_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the first write of an index fail as on a full disk."""
    write_end, refusals = ChunkFile.write_end, [True]

    def full_once(file: ChunkFile) -> None:
        if refusals:
            refusals.pop()
            raise OutputError(f"{file.part}: full", errno.ENOSPC)
        write_end(file)

    monkeypatch.setattr(ChunkFile, "write_end", full_once)


@pytest.mark.parametrize("make_copy", [recover, lambda path: cut(path, 1_000, TICKS)], ids=["recover", "cut"])
def test_a_copy_drops_no_tick_for_its_index(
    part: Path, make_copy: Callable[[Path], object], monkeypatch: pytest.MonkeyPatch
):
    before = sorted(part.parent.iterdir())
    refuse_the_end_once(monkeypatch)
    with pytest.raises(OutputError, match="full"):
        make_copy(part)
    assert sorted(part.parent.iterdir()) == before


def test_a_file_that_cannot_be_recovered_is_not_removed(
    part: Path, keeper: RecorderKeeper, monkeypatch: pytest.MonkeyPatch
):
    refuse_the_end_once(monkeypatch)
    RecorderKeeper._repair(keeper, part)
    assert (part.exists(), "full" in keeper.notes[0]) == (True, True)
    RecorderKeeper._repair(keeper, part)
    assert (part.exists(), len(load(part.with_suffix("")))) == (False, TICKS)


def test_an_original_that_cannot_be_removed_after_its_recovery_is_named(
    part: Path, keeper: RecorderKeeper, monkeypatch: pytest.MonkeyPatch
):
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", lambda path, missing_ok=False: path == part and refuse())
        RecorderKeeper._repair(keeper, part)
    assert ["tick" in note for note in keeper.notes] == [True, False]
    assert str(part) in keeper.notes[1]


def test_a_folder_without_a_status_refuses_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(os, "lstat", refuse)
    with pytest.raises(OutputError, match=os.strerror(errno.EIO)):
        Writer(tmp_path / "run.mcap", make_header(), START_UNIX_NS)


def test_a_file_whose_lock_cannot_be_tested_is_not_recovered(part: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(RecordingError, match="cannot be locked"):
        recover(part)
    assert find_leftovers(part.parent) == []


@pytest.mark.parametrize("make_copy", [recover, cut], ids=["recover", "cut"])
def test_an_old_copy_that_cannot_be_removed_refuses_a_new_one(
    part: Path, make_copy: Callable[[Path], object], monkeypatch: pytest.MonkeyPatch
):
    for path in part.with_name("killed.mcap.recovering"), cut_path(part, 0).with_name("killed.cut-0.mcap.cutting"):
        path.touch()
    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(OutputError, match=os.strerror(errno.EIO)):
        make_copy(part)


@pytest.mark.parametrize("make_copy", [recover, cut], ids=["recover", "cut"])
def test_a_second_copy_at_the_same_time_is_refused_and_the_first_one_is_whole(
    part: Path, make_copy: Callable[..., Any]
):
    refusals: list[str] = []

    def start_again(_: int) -> None:
        with pytest.raises(OutputError) as error:
            make_copy(part)
        refusals.append(str(error.value))

    report = make_copy(part, progress=start_again)
    assert report["ticks"] == len(load(report["output"])) == TICKS
    assert refusals
    assert {refusal.partition(": ")[2] for refusal in refusals} == {"another process writes the same recording"}


def test_a_folder_that_cannot_be_synced_does_not_undo_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda fd: refuse() if os.path.isdir(f"/proc/self/fd/{fd}") else fsync(fd))
    assert len(load(write_recording(tmp_path / "run.mcap", make_rows(TICKS)))) == TICKS


def test_a_run_whose_last_file_cannot_be_begun_is_not_complete(disk: Disk, tmp_path: Path):
    run = RecordedRun(tmp_path / "run.mcap", rotate_s=1.0)
    run.run_to(SECOND + SECOND // 2)
    disk.inodes = False
    totals = run.end(2 * SECOND + SECOND // 2)
    summary = summarise(totals["paths"])
    assert (totals["complete"], totals["ticks_lost"]) == (False, SECOND // 2)
    assert (summary.complete, summary.ticks_lost) == (False, SECOND // 2)


def test_a_run_whose_last_file_gets_no_tick_is_not_complete(disk: Disk, tmp_path: Path):
    run = RecordedRun(tmp_path / "run.mcap", rotate_s=1.0)
    run.run_to(2 * SECOND + 100)
    disk.longest_write_bytes = 40_000  # Enough for the beginning of a file, not for ticks.
    totals = run.end(2 * SECOND + SECOND // 2)
    assert (len(totals["paths"]), totals["complete"], totals["ticks_lost"]) == (2, False, SECOND // 2)
    summary = summarise(totals["paths"])
    assert (summary.complete, summary.problems) == (False, ["file 3 of the run is missing"])


def test_ticks_that_are_dropped_for_the_index_count_as_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    run = RecordedRun(tmp_path / "run.mcap")
    run.run_to(SECOND)
    refuse_the_end_once(monkeypatch)
    totals = run.end()
    assert totals["ticks_logged"] == len(load(totals["paths"])) < SECOND
    load_word = run.loop.block.load
    assert load_word(Word.FLUSHED_TICKS) - load_word(Word.LOST_TICKS) == totals["ticks_logged"]
