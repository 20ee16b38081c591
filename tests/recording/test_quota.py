"""A quota removes the oldest recordings of a configuration, but none around a trip."""

from __future__ import annotations

import errno
import json
import os
import queue
import time
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtloop.configuration.recording import RecordingOptions
from rtloop.engine.memory import ProcessState, Word
from rtloop.engine.messages import Kind, message
from rtloop.foundation import timing
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.topics.contents import event_message
from rtloop.recording.file.topics.events import event_from_message
from rtloop.recording.file.writer import Writer
from rtloop.recording.load import load
from rtloop.signals import Flag
from rtloop.supervision import quota as quota_module
from rtloop.supervision import recorder_keeper
from rtloop.supervision.quota import SPARE_BYTES, Quota
from rtloop.supervision.recorder_keeper import RecorderKeeper
from tests.recording.hand_made_loop import AXES, START_UNIX_NS, HandMadeLoop, final_message, make_header, make_rows

PART_TICKS = 5_000
"""Number of ticks that a file accounts for: half a second."""
AROUND = {"before_s": 0.1, "after_s": 0.2, "every_s": 1.0, "on": ["trip"]}


def write_file(
    folder: Path, stem: str, number: int = 1, trips: Sequence[int] = (), kind: Kind = Kind.TRIPPED, **header: object
) -> Path:
    """Write file `number` of a run, with an event of `kind` at each of the ticks `trips`. Returns its path."""
    first = (number - 1) * PART_TICKS
    header = make_header(sequence=number, first_tick=first, format=2, around=AROUND, **header)
    writer = Writer(folder / f"{stem}.mcap", header, START_UNIX_NS)
    for trip in trips:
        record = message(kind, tick=trip, axis=0, values=[Flag.TRIP_POSITION])[0]
        writer.write_messages([event_message(event_from_message(record, AXES, 0), START_UNIX_NS)])
    writer.write_ticks(make_rows(1_000, first=first))
    writer.finish(lambda logged: final_message(first + PART_TICKS, logged))
    return writer.path


def write_run(
    folder: Path, stamp: str, files: int, *trips: int, name: str = "test", kind: Kind = Kind.TRIPPED
) -> list[Path]:
    """Write the files of one run, with an event of `kind` at each of the ticks `trips`. Returns their paths."""
    created = START_UNIX_NS + int(stamp[-1]) * 10**9
    return [
        write_file(
            folder,
            f"{name}-{stamp}-{number:04d}",
            number,
            [trip for trip in trips if trip // PART_TICKS + 1 == number],
            kind,
            created_unix_ns=created,
            name=name,
        )
        for number in range(1, files + 1)
    ]


def apply_quota(folder: Path, files: int) -> Quota:
    """Apply a quota of the size of `files` files three times. Returns the quota."""
    size = max(path.stat().st_size for path in folder.glob("test-*.mcap"))
    quota = Quota(folder, "test", files * size, 0)
    for _ in range(3):
        quota.enforce(budget_s=60.0)
    return quota


@pytest.fixture(autouse=True)
def disk_status(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The status of the disk, which has a TiB free until a test changes it."""
    status = SimpleNamespace(f_bavail=1 << 40, f_frsize=1)
    monkeypatch.setattr(os, "statvfs", lambda _: status)
    return status


def require_files(folder: Path, *paths: Path) -> None:
    """Require that the folder holds exactly these files."""
    assert sorted(folder.iterdir()) == sorted(paths)


def test_the_oldest_files_are_removed_first(tmp_path: Path):
    old, new = write_run(tmp_path, "20260101T000001", 3), write_run(tmp_path, "20260102T000002", 3)
    size = sum(path.stat().st_size for path in old[:2])
    quota = apply_quota(tmp_path, 4)
    require_files(tmp_path, old[2], *new)
    assert (quota.removed_files, quota.removed_bytes) == (2, size)
    assert quota.total_bytes == sum(path.stat().st_size for path in tmp_path.iterdir())


@pytest.mark.parametrize("kind", [Kind.TRIPPED, Kind.DRIVER_FAILED])
def test_no_file_around_a_trip_is_removed_whatever_the_quota(tmp_path: Path, kind: Kind):
    """The neighbour with ticks around the trip is not removed either, nor is the newest file."""
    # before_s of the first trip reaches into the second file here, after_s of the second trip into the fourth one, and
    # after_s into the third file of the later run.
    files = write_run(tmp_path, "20260101T000001", 7, 2 * PART_TICKS + 500, 3 * PART_TICKS - 500, kind=kind)
    later_files = write_run(tmp_path, "20260102T000002", 6, 2 * PART_TICKS - 500, kind=kind)
    apply_quota(tmp_path, 1)
    require_files(tmp_path, *files[1:4], *later_files[1:3], later_files[-1])


def test_other_files_are_not_removed(tmp_path: Path):
    run_files = write_run(tmp_path, "20260101T000001", 4)
    foreign_files = [
        write_file(tmp_path, "test-20260101T000001.cut-5"),
        write_file(tmp_path, "test-mine"),
        write_file(tmp_path, "other-20260101T000001", name="other"),
        write_file(tmp_path, "test-20250101T000001", name="other"),
        write_file(tmp_path, "test-20250101T000002", cut={"first": 0, "end": 9, "files": []}),
    ]
    damaged, unfinished, link = (
        tmp_path / f"test-20250101T00000{name}" for name in ("3.mcap", "4.mcap.part", "5.mcap")
    )
    for path in (damaged, unfinished):
        path.write_bytes(run_files[0].read_bytes()[:-3000])
    link.symlink_to(foreign_files[0])
    apply_quota(tmp_path, 1)
    require_files(tmp_path, run_files[-1], *foreign_files, damaged, unfinished, link)


def test_files_are_removed_when_the_disk_is_nearly_full(tmp_path: Path, disk_status: SimpleNamespace):
    files = write_run(tmp_path, "20260101T000001", 4, 500)
    quota = Quota(tmp_path, "test", 1 << 40, 10 << 20)
    assert quota.enforce() == []
    disk_status.f_bavail = (10 << 20) + SPARE_BYTES - 1
    first, _ = quota.enforce(budget_s=60.0)
    assert ("less than 74 MiB are free" in first.reason, str(first)) == (
        True,
        f"{files[1]} was removed: {first.reason}",
    )
    require_files(tmp_path, files[0], files[-1])


def test_an_unread_file_is_not_removed(tmp_path: Path):
    files = write_run(tmp_path, "20260101T000001", 4)
    assert Quota(tmp_path, "test", 1, 0).enforce(budget_s=0.0) == []
    require_files(tmp_path, *files)


def test_no_file_is_removed_while_one_of_the_folder_has_no_status(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The file may hold a trip whose first ticks are in an earlier file."""
    files, lstat = write_run(tmp_path, "20260101T000001", 4, PART_TICKS + 1), os.lstat

    def refuse(path: Any, *arguments: Any, **options: Any) -> os.stat_result:
        if Path(path) == files[1]:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return lstat(path, *arguments, **options)

    monkeypatch.setattr(os, "lstat", refuse)
    quota = Quota(tmp_path, "test", 1, 0)
    assert quota.enforce(budget_s=60.0) == []
    assert quota.failure == f"{tmp_path}: {os.strerror(errno.EIO)}"


def test_a_missing_folder_is_a_failure(tmp_path: Path):
    quota = Quota(tmp_path / "gone", "test", 1, 0)
    assert quota.enforce() == []
    assert quota.failure == f"{tmp_path / 'gone'}: No such file or directory"


class StubRecorder:
    """Stand-in for a recorder process, which only receives lines."""

    def __init__(self) -> None:
        self.exit_code, self.lines = None, queue.SimpleQueue[bytes]()
        self.send, self.reports = self.lines.put, list

    def wait(self, timeout_s: float) -> int:
        return 0

    def end(self) -> bool:
        return True


def test_the_recorder_receives_removals_and_a_failure_is_listed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(recorder_keeper, "QUOTA_S", 0.0)
    folder, loop, child = tmp_path / "there", HandMadeLoop(), StubRecorder()
    folder.mkdir()
    files = write_run(folder, "20260101T000001", 3)
    loop.block.store(Word.RECORDER_STATE, ProcessState.RUNNING)
    options = RecordingOptions(keep_gib=1e-9)
    keeper = RecorderKeeper(child, loop.block, RequesterNames.create(), folder / "test-now.mcap", options)  # pyright: ignore
    keeper.start({"name": "test"})
    assert set(json.loads(child.lines.get(timeout=60))) == {"path", "header", "options"}
    lines = b""
    while lines.count(b"\n") < 2:
        lines += child.lines.get(timeout=60)
    removals = [json.loads(line)["removed"] for line in lines.splitlines()]
    assert [removal["file"] for removal in removals] == [path.name for path in files[:2]]
    assert (removals[0]["reason"].endswith("(recording.keep_gib)"), removals[0]["size_bytes"] > 1000) == (True, True)
    folder.rename(tmp_path / "gone")
    while len(keeper.removals) < 3:
        time.sleep(0.001)
    keeper.finish()
    while keeper.totals is None:  # The keeper applies the quota once more.
        time.sleep(0.001)
    assert keeper.removals[2:] == [f"{folder}: No such file or directory"]


def test_the_files_written_here_can_be_read(tmp_path: Path):
    (path,) = write_run(tmp_path, "20260101T000001", 1, 20)
    assert np.array_equal(load(path)["tick"], np.arange(1_000))


def test_no_file_of_a_run_is_removed_before_all_were_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A trip in an unread file protects the file before it."""
    files = write_run(tmp_path, "20260101T000001", 5, 2 * PART_TICKS + 500)
    seconds = count()
    monkeypatch.setattr(timing, "source", timing.Source(monotonic_s=lambda: float(next(seconds))))
    quota = Quota(tmp_path, "test", 1, 0)
    assert quota.enforce(budget_s=2.5) == []  # Time for two files.
    require_files(tmp_path, *files)
    for _ in range(2):
        quota.enforce(budget_s=2.5)
    require_files(tmp_path, *files[1:3], files[-1])


def test_a_run_with_an_unreadable_file_is_not_removed_as_it_may_hold_a_trip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    write_run(tmp_path, "20260101T000001", 2)
    tripped = write_run(tmp_path, "20260102T000002", 2, PART_TICKS + 1)
    write_run(tmp_path, "20260103T000003", 1)
    enter = quota_module.Reader.__init__

    def refuse(reader: Any, path: Path, **options: Any) -> None:
        if path == tripped[1]:
            raise RecordingError(f"{path}: Input/output error")
        enter(reader, path, **options)

    monkeypatch.setattr(quota_module.Reader, "__init__", refuse)
    apply_quota(tmp_path, 0)
    assert all(path.exists() for path in tripped)
