"""A system call that fails once: the file system refuses, and no file says more than it holds."""

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
from tests.recording.disk import Disk, Recorded
from tests.recording.hand_made_loop import START_UNIX_NS, make_header, make_rows, write_recording

TICKS, PART_BYTES = 3_000, 100
SECOND = 10_000


@pytest.fixture
def finished(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "run.mcap", make_rows(TICKS))


@pytest.fixture
def part(finished: Path) -> Path:
    """The unfinished file of a recorder that was killed while it wrote the index."""
    part = finished.with_name("killed.mcap.part")
    part.write_bytes(finished.read_bytes()[:-PART_BYTES])
    return part


def refuse(*_: object, **__: object) -> Any:
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def refuse_the_end_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no room for the first index that is written."""
    write_end, refused = ChunkFile.write_end, []

    def full_once(file: ChunkFile) -> None:
        if not refused:
            refused.append(True)
            raise OutputError(f"{file.part}: full", errno.ENOSPC)
        write_end(file)

    monkeypatch.setattr(ChunkFile, "write_end", full_once)


@pytest.mark.parametrize("copy", [recover, lambda path: cut(path, 1_000, TICKS)], ids=["recover", "cut"])
def test_a_copy_gives_up_no_tick_for_its_index(
    part: Path, copy: Callable[[Path], object], monkeypatch: pytest.MonkeyPatch
):
    before = sorted(part.parent.iterdir())
    refuse_the_end_once(monkeypatch)
    with pytest.raises(OutputError, match="full"):
        copy(part)
    assert sorted(part.parent.iterdir()) == before


def test_what_cannot_be_recovered_is_not_removed(part: Path, monkeypatch: pytest.MonkeyPatch):
    keeper = cast(RecorderKeeper, SimpleNamespace(notes=[]))
    refuse_the_end_once(monkeypatch)
    RecorderKeeper._repair(keeper, part)
    assert part.exists()
    assert "full" in keeper.notes[0]
    RecorderKeeper._repair(keeper, part)
    assert not part.exists()
    assert len(load(part.with_suffix(""))) == TICKS


def test_a_recovered_file_whose_original_cannot_be_removed_is_told(part: Path, monkeypatch: pytest.MonkeyPatch):
    keeper = cast(RecorderKeeper, SimpleNamespace(notes=[]))
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", lambda path, missing_ok=False: path == part and refuse())
        RecorderKeeper._repair(keeper, part)
    assert ["tick" in note for note in keeper.notes] == [True, False]
    assert str(part) in keeper.notes[1]


def test_a_folder_that_cannot_be_looked_into_refuses_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(os, "lstat", refuse)
    with pytest.raises(OutputError, match=os.strerror(errno.EIO)):
        Writer(tmp_path / "run.mcap", make_header(), START_UNIX_NS)


def test_a_lock_that_cannot_be_asked_for_leaves_a_file_alone(part: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(RecordingError, match="cannot be locked"):
        recover(part)
    assert find_leftovers(part.parent) == []


@pytest.mark.parametrize("kind", [recover, cut], ids=["recover", "cut"])
def test_an_old_copy_that_cannot_be_removed_refuses_a_new_one(
    part: Path, kind: Callable[[Path], object], monkeypatch: pytest.MonkeyPatch
):
    names = part.with_name("killed.mcap.recovering"), cut_path(part, 0).with_name("killed.cut-0.mcap.cutting")
    for name in names:
        name.touch()
    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(OutputError, match=os.strerror(errno.EIO)):
        kind(part)


def test_a_folder_that_cannot_be_synced_takes_no_file_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda fd: refuse() if os.path.isdir(f"/proc/self/fd/{fd}") else fsync(fd))
    path = write_recording(tmp_path / "run.mcap", make_rows(TICKS))
    assert len(load(path)) == TICKS


def test_a_run_whose_last_file_cannot_be_begun_is_not_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    disk = Disk(monkeypatch)
    recorded = Recorded(tmp_path / "run.mcap", rotate_s=1.0)
    recorded.run_to(SECOND + SECOND // 2)
    disk.inodes = False
    recorded.run_to(2 * SECOND + SECOND // 2)
    totals = recorded.end()
    summary = summarise(totals["paths"])
    assert (totals["complete"], totals["ticks_lost"]) == (False, SECOND // 2)
    assert (summary.complete, summary.ticks_lost) == (False, SECOND // 2)


def test_a_run_whose_last_file_gets_no_tick_is_not_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    disk = Disk(monkeypatch)
    recorded = Recorded(tmp_path / "run.mcap", rotate_s=1.0)
    recorded.run_to(2 * SECOND + 100)
    disk.longest_write_bytes = 40_000  # enough for a file's beginning, not for ticks
    recorded.run_to(2 * SECOND + SECOND // 2)
    totals = recorded.end()
    assert (len(totals["paths"]), totals["complete"], totals["ticks_lost"]) == (2, False, SECOND // 2)
    summary = summarise(totals["paths"])
    assert (summary.complete, summary.problems) == (False, ["part 3 of the run is missing"])


def test_ticks_that_make_room_for_the_index_are_not_said_to_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    recorded = Recorded(tmp_path / "run.mcap")
    recorded.run_to(SECOND)
    refuse_the_end_once(monkeypatch)
    totals = recorded.end()
    assert totals["ticks_logged"] == len(load(totals["paths"])) < SECOND
    load_word = recorded.loop.block.load
    assert load_word(Word.FLUSHED_TICKS) - load_word(Word.LOST_TICKS) == totals["ticks_logged"]
