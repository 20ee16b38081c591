"""Files that a program reads, or has open, while they are renamed, cut, removed by a quota or rewritten."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

import h5py
import numpy as np
import pytest
from mcap.records import Header

from rtloop.errors import OutputError
from rtloop.foundation.trusted import replace_file
from rtloop.recording.cutting.cut import cut
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.mcap import chunkfile
from rtloop.recording.file.mcap.chunkfile import ChunkFile
from rtloop.recording.file.reader import Reader
from rtloop.recording.load import load
from rtloop.supervision.quota import Quota
from tests.command_line import run
from tests.recording.hand_made_loop import make_rows, write_recording
from tests.recording.real_loop import RecordedRun

FIRST, END = 12_000, 15_000
STAMP = "20260101T00000"


def test_a_reader_sees_what_it_opened_while_the_file_is_cut_finished_and_removed(tmp_path: Path):
    recorded, part = RecordedRun(tmp_path / "run.mcap"), tmp_path / "run.mcap.part"
    recorded.run_to(FIRST)
    recorded.session._write_all()
    with Reader(part, tolerant=True) as reader:
        cut(part, 10_500, 11_500, tmp_path / "cut.mcap")
        recorded.end(END)
        (tmp_path / "run.mcap").unlink()
        ticks = np.concatenate([rows[:, 0] for rows in reader.blocks(["tick"])])
        assert ticks.tolist() == list(range(FIRST))
    assert load(tmp_path / "cut.mcap")["tick"].tolist() == list(range(10_000, 11_500))


def test_the_message_about_a_growing_file_names_the_finished_one(tmp_path: Path):
    recorded = RecordedRun(tmp_path / "run.mcap")
    recorded.run_to(FIRST)
    growing = load(tmp_path / "run.mcap.part")
    recorded.end()
    with pytest.raises(RecordingError, match=r"run\.mcap\.part: no such file, but there is run\.mcap"):
        growing.read("tick")


def test_a_reader_continues_after_a_quota_removed_its_file(tmp_path: Path):
    rows = make_rows(2_000)
    old, _ = (write_recording(tmp_path / f"test-{STAMP}{n}.mcap", rows, created_unix_ns=n) for n in (1, 2))
    with Reader(old) as reader:
        quota = Quota(tmp_path, "test", 1, 0)
        assert [removal.file for removal in quota.enforce(budget_s=60.0)] == [old]
        assert np.concatenate(list(reader.blocks())).tobytes() == rows.tobytes()
    with pytest.raises(RecordingError, match="no such file"):
        load(old)


@pytest.mark.parametrize("form", ["csv", "hdf5"])
def test_an_export_does_not_change_a_file_that_another_program_has_open(tmp_path: Path, form: str):
    recording = write_recording(tmp_path / "run.mcap", make_rows(100))
    output = tmp_path / f"run.{form}"
    with output.open("w+b") as open_file:
        open_file.write(b"of another program")
        open_file.flush()
        fcntl.flock(open_file, fcntl.LOCK_EX)
        result = run("export", recording, "--to", form, "--out", output)
        assert (result.exit_code, "exists" in result.output) == (73, True), result.output
    assert output.read_bytes() == b"of another program"


def test_a_file_that_another_program_is_writing_is_refused_with_a_reason(tmp_path: Path):
    path = tmp_path / "measured.h5"
    with h5py.File(path, "w") as file:
        file["a"] = np.arange(10.0)
    with path.open("rb") as locked_file:
        fcntl.flock(locked_file, fcntl.LOCK_EX)
        result = run("import", path)
    assert (result.exit_code, str(path) in result.output.replace("\n", "")) == (1, True), result.output


def test_a_recording_that_another_process_begins_is_refused_and_no_file_stays_open(tmp_path: Path):
    first = ChunkFile(tmp_path / "run.mcap", Header("", "test"), [])
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(OutputError, match="another process writes the same recording"):
        ChunkFile(tmp_path / "run.mcap", Header("", "test"), [])
    assert len(os.listdir("/proc/self/fd")) == before
    first.discard()
    assert list(tmp_path.iterdir()) == []


def test_a_process_that_is_a_moment_quicker_to_lock_the_new_file_has_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The other process locks the file between its creation and its lock; no system call joins these two steps."""
    locked_fds = []

    def replace_and_lock_first(path: Path, mode: int) -> int:
        fd = replace_file(path, mode)
        locked_fds.append(os.open(path, os.O_RDONLY))
        fcntl.flock(locked_fds[-1], fcntl.LOCK_EX)
        return fd

    monkeypatch.setattr(chunkfile, "replace_file", replace_and_lock_first)
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(OutputError, match="another process writes the same recording"):
        ChunkFile(tmp_path / "run.mcap", Header("", "test"), [])
    assert len(os.listdir("/proc/self/fd")) == before + 1
    os.close(locked_fds[0])


def test_a_reader_of_some_seconds_leaves_the_other_chunks_alone(tmp_path: Path):
    path = write_recording(tmp_path / "run.mcap", make_rows(60_000))
    with Reader(path) as reader:
        every, some = reader.tick_chunks, reader.chunks_between(2.0, 2.5)
        assert some is not None
        assert len(every) > 5
        assert 0 < len(some) <= 2 + len(every) // 10
        ticks = np.concatenate([rows[:, 0] for rows in reader.blocks(["tick"], some)])
        assert (ticks[0] <= 20_000, ticks[-1] >= 24_999) == (True, True)
        assert reader.chunks_between(0.0, np.inf) is None


def test_a_file_that_is_closed_twice_closes_no_other_one(tmp_path: Path):
    reader = Reader(write_recording(tmp_path / "run.mcap", make_rows(100)))
    reader.close()
    other_fd = os.open(tmp_path / "other", os.O_CREAT | os.O_RDWR)  # The descriptor gets the number of the closed file.
    reader.close()
    os.fstat(other_fd)
    os.close(other_fd)
