"""What a quota removes: the oldest of a configuration's own recordings, and never one around a trip."""

from __future__ import annotations

import errno
import json
import os
import queue
import time
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtloop.configuration.recording import RecordingOptions
from rtloop.engine.memory import ProcessState, Word
from rtloop.engine.messages import Kind, message
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.events import event_from_message
from rtloop.recording.file.topics.format import EVENTS
from rtloop.recording.file.writer import Writer
from rtloop.signals import Flag
from rtloop.supervision import quota as quota_module
from rtloop.supervision import recorder_keeper
from rtloop.supervision.quota import SPARE_BYTES, Quota
from rtloop.supervision.recorder_keeper import RecorderKeeper
from tests.recording.hand_made_loop import AXES, START_UNIX_NS, HandMadeLoop, final_message, make_header, make_rows

PART = 5_000
"""Ticks in a file: half a second."""
AROUND = {"before_s": 0.1, "after_s": 0.2, "every_s": 1.0, "on": ["trip"]}


def write(
    folder: Path, stem: str, number: int = 1, trip: int | None = None, kind: Kind = Kind.TRIPPED, **header: object
) -> Path:
    """File `number` of a run, in which it tripped, or its driver failed, at a tick."""
    first = (number - 1) * PART
    said = make_header(sequence=number, first_tick=first, format=2, around=AROUND, **header)
    writer = Writer(folder / f"{stem}.mcap", said, START_UNIX_NS)
    if trip is not None:
        record = message(kind, tick=trip, axis=0, values=[Flag.TRIP_POSITION])[0]
        writer.write_messages(
            [Message(EVENTS, START_UNIX_NS, json.dumps(event_from_message(record, AXES, 0)).encode())]
        )
    writer.write_ticks(make_rows(1_000, first=first))
    writer.finish(lambda logged: final_message(first + PART, logged))
    return writer.path


def run_of(
    folder: Path, stamp: str, files: int, trip: int | None = None, name: str = "test", kind: Kind = Kind.TRIPPED
) -> list[Path]:
    """The files of one run, of which those that have it say at which tick it tripped."""
    at = {} if trip is None else {trip // PART + 1: trip}
    created = START_UNIX_NS + int(stamp[-1]) * 10**9
    return [
        write(folder, f"{name}-{stamp}-{number:04d}", number, at.get(number), kind, created_unix_ns=created, name=name)
        for number in range(1, files + 1)
    ]


def keep(folder: Path, files: int) -> Quota:
    """A quota for so many files, applied."""
    size = max(path.stat().st_size for path in folder.glob("test-*.mcap"))
    quota = Quota(folder, "test", files * size, 0)
    for _ in range(3):
        quota.enforce(budget_s=60.0)
    return quota


@pytest.fixture(autouse=True)
def disk(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """With a TiB free."""
    status = SimpleNamespace(f_bavail=1 << 40, f_frsize=1)
    monkeypatch.setattr(os, "statvfs", lambda _: status)
    return status


def left(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_oldest_go_first(tmp_path: Path):
    old, new = run_of(tmp_path, "20260101T000001", 3), run_of(tmp_path, "20260102T000002", 3)
    size = sum(path.stat().st_size for path in old[:2])
    quota = keep(tmp_path, 4)
    assert left(tmp_path) == [path.name for path in [old[2], *new]]
    assert (quota.removed_files, quota.removed_bytes) == (2, size)
    assert quota.total_bytes == sum(path.stat().st_size for path in tmp_path.iterdir())


def test_none_around_a_trip_goes_whatever_the_quota(tmp_path: Path):
    """Nor the neighbour that begins, or ends, with what is around it; nor the newest."""
    files = run_of(tmp_path, "20260101T000001", 7, trip=2 * PART + 500)  # before_s reaches into the second
    late = run_of(tmp_path, "20260102T000002", 6, trip=2 * PART - 500)  # after_s reaches into the third
    keep(tmp_path, 1)
    assert left(tmp_path) == [path.name for path in (*files[1:3], *late[1:3], late[-1])]


def test_what_others_put_there_stays(tmp_path: Path):
    mine = run_of(tmp_path, "20260101T000001", 4)
    others = [
        write(tmp_path, "test-20260101T000001.cut-5"),
        write(tmp_path, "test-mine"),
        write(tmp_path, "other-20260101T000001", name="other"),
        write(tmp_path, "test-20250101T000001", name="other"),
        write(tmp_path, "test-20250101T000002", cut={"first": 0, "end": 9, "files": []}),
    ]
    damaged, unfinished = tmp_path / "test-20250101T000003.mcap", tmp_path / "test-20250101T000004.mcap.part"
    damaged.write_bytes(mine[0].read_bytes()[:-3000])
    unfinished.write_bytes(mine[0].read_bytes()[:-3000])
    (tmp_path / "test-20250101T000005.mcap").symlink_to(others[0])
    keep(tmp_path, 1)
    expected = [mine[-1], *others, damaged, unfinished, tmp_path / "test-20250101T000005.mcap"]
    assert left(tmp_path) == sorted(path.name for path in expected)


def test_a_disk_that_fills_counts_as_much(tmp_path: Path, disk: SimpleNamespace):
    files = run_of(tmp_path, "20260101T000001", 4, trip=500)
    quota = Quota(tmp_path, "test", 1 << 40, 10 << 20)
    assert quota.enforce() == []
    disk.f_bavail = (10 << 20) + SPARE_BYTES - 1
    gone, *more = quota.enforce(budget_s=60.0)
    assert "less than 74 MiB are free" in gone.reason
    assert str(gone) == f"{files[1]} was removed: {gone.reason}"
    assert [name for name in left(tmp_path)] == [files[0].name, files[-1].name]
    assert len(more) == 1


def test_what_was_not_looked_at_yet_is_not_removed(tmp_path: Path):
    files = run_of(tmp_path, "20260101T000001", 4)
    assert Quota(tmp_path, "test", 1, 0).enforce(budget_s=0.0) == []
    assert len(left(tmp_path)) == len(files)


def test_a_file_that_cannot_be_looked_at_holds_back_its_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """It may hold the trip that the file before it leads to."""
    files, lstat = run_of(tmp_path, "20260101T000001", 4, trip=PART + 1), os.lstat

    def refuse(path: Any, *arguments: Any, **options: Any) -> os.stat_result:
        if Path(path) == files[1]:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return lstat(path, *arguments, **options)

    monkeypatch.setattr(os, "lstat", refuse)
    quota = Quota(tmp_path, "test", 1, 0)
    assert quota.enforce(budget_s=60.0) == []
    assert quota.failure == f"{tmp_path}: {os.strerror(errno.EIO)}"


def test_a_folder_that_is_gone_is_said(tmp_path: Path):
    quota = Quota(tmp_path / "gone", "test", 1, 0)
    assert quota.enforce() == []
    assert quota.failure == f"{tmp_path / 'gone'}: No such file or directory"


class Listener:
    """A recorder that only listens."""

    def __init__(self) -> None:
        self.exit_code, self.heard = None, queue.SimpleQueue[bytes]()
        self.send, self.reports = self.heard.put, list

    def wait(self, timeout_s: float) -> int:
        return 0

    def end(self) -> bool:
        return True


def test_the_recorder_is_told_what_went_and_a_failure_is_said_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(recorder_keeper, "QUOTA_S", 0.0)
    folder, loop, child = tmp_path / "there", HandMadeLoop(), Listener()
    folder.mkdir()
    files = run_of(folder, "20260101T000001", 3)
    loop.block.store(Word.RECORDER_STATE, ProcessState.RUNNING)
    options = RecordingOptions(keep_gib=1e-9)
    keeper = RecorderKeeper(child, loop.block, RequesterNames.create(), folder / "test-now.mcap", options)  # pyright: ignore
    keeper.start({"name": "test"})
    assert set(json.loads(child.heard.get(timeout=60))) == {"path", "header", "options"}
    lines = b""
    while lines.count(b"\n") < 2:
        lines += child.heard.get(timeout=60)
    said = [json.loads(line)["removed"] for line in lines.splitlines()]
    assert [one["file"] for one in said] == [path.name for path in files[:2]]
    assert said[0]["reason"].endswith("(recording.keep_gib)")
    assert said[0]["size_bytes"] > 1000
    folder.rename(tmp_path / "gone")
    while len(keeper.removals) < 3:
        time.sleep(0.001)
    keeper.finish()
    while keeper.totals is None:  # it looks once more
        time.sleep(0.001)
    assert keeper.removals[2:] == [f"{folder}: No such file or directory"]


def test_the_rows_that_are_written_here_can_be_read(tmp_path: Path):
    from rtloop.recording.load import load

    (path,) = run_of(tmp_path, "20260101T000001", 1, trip=20)
    assert np.array_equal(load(path)["tick"], np.arange(1_000))


def test_a_driver_that_failed_protects_as_a_trip_does(tmp_path: Path):
    files = run_of(tmp_path, "20260101T000001", 6, trip=2 * PART + 500, kind=Kind.DRIVER_FAILED)
    keep(tmp_path, 1)
    assert left(tmp_path) == [path.name for path in (*files[1:3], files[-1])]


def test_nothing_of_a_run_goes_before_all_of_it_was_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A trip in a file that was not opened yet protects the one before it."""
    files = run_of(tmp_path, "20260101T000001", 5, trip=2 * PART + 500)
    ticking = count()
    monkeypatch.setattr(quota_module, "time", SimpleNamespace(monotonic=lambda: float(next(ticking))))
    quota = Quota(tmp_path, "test", 1, 0)
    assert quota.enforce(budget_s=2.5) == []  # time for two files
    assert len(left(tmp_path)) == len(files)
    quota.enforce(budget_s=2.5)
    quota.enforce(budget_s=2.5)
    assert left(tmp_path) == [path.name for path in (*files[1:3], files[-1])]


def test_a_run_with_a_file_that_cannot_be_read_stays_for_a_trip_may_be_in_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    run_of(tmp_path, "20260101T000001", 2)
    tripped = run_of(tmp_path, "20260102T000002", 2, trip=PART + 1)
    run_of(tmp_path, "20260103T000003", 1)
    enter = quota_module.Reader.__init__

    def refuse(reader: Any, path: Path, **options: Any) -> None:
        if path == tripped[1]:
            raise RecordingError(f"{path}: Input/output error")
        enter(reader, path, **options)

    monkeypatch.setattr(quota_module.Reader, "__init__", refuse)
    keep(tmp_path, 0)
    assert all(path.exists() for path in tripped)
