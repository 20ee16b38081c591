"""Archives: exactly the bad recordings are named, for any kind of workers, and after any process was killed."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from collections.abc import Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import pytest

from rtloop.campaigns.archive import examine
from rtloop.campaigns.archive_files import find_recordings
from rtloop.campaigns.archive_table import REPEATED, open_table
from rtloop.campaigns.archive_verdict import INFO, REPLAY, Examination, replay_files, summarise_files
from rtloop.campaigns.dispatcher import Dispatcher, Task
from rtloop.campaigns.workers import WorkerDied
from rtloop.errors import UnavailableError
from rtloop.recording.errors import RecordingError
from rtloop.version import __version__
from tests.campaigns.bad_recordings import (
    BAD,
    DRIVE_TICK,
    archive,
    bad_rows,
    change_header,
    dask_cluster,
    flip_tick_byte,
    make_archive,
    record_short_run,
    require_exact,
)
from tests.campaigns.campaign_files import rtloop
from tests.command_line import run
from tests.recording import rewriting
from tests.recording.forging import pack_file, record_bases
from tests.recording.real_loop import eventful_configuration, record
from tests.recording.tamper import flip_byte
from tests.recording.test_verdict import drop_chunks, drop_snapshots
from tests.users import ROOT_ONLY, VICTIM, as_user

GOOD = 17
SLOW_S = "0.2"
HOOK = """
import os
if os.environ.get("HOOK"):
    import time
    import rtloop.recording.load as load
    load_recording = load.load
    def load_or_die(paths):
        if os.environ["HOOK"] in str(paths):
            os.kill(os.getpid(), 11)
        time.sleep(float(os.environ.get("SLOW_S", 0)))
        return load_recording(paths)
    load.load = load_or_die
"""
"""A `sitecustomize`: the load of a recording named HOOK ends the process by SIGSEGV; any other load takes SLOW_S."""


@pytest.fixture(scope="module")
def good_recording(tmp_path_factory):
    """A short recording of the paper's loop."""
    return record_short_run(tmp_path_factory.mktemp("good"))


@pytest.fixture(scope="module")
def folder(good_recording, tmp_path_factory):
    """An archive of good and bad recordings."""
    folder = tmp_path_factory.mktemp("archive")
    make_archive(folder, good_recording, GOOD, list(BAD))
    return folder


@pytest.fixture(scope="module")
def report(folder):
    """The report on the archive by one worker."""
    code, report = archive("replay", folder, "--jobs", 1, folder=folder)
    assert code == 1
    return report


def hook_environment(tmp_path: Path, name: str, slow_s: str = "0") -> dict[str, str]:
    """Return an environment with HOOK in force: the recording `name` ends its worker, any other one takes `slow_s`."""
    (tmp_path / "sitecustomize.py").write_text(HOOK)
    paths = [str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {"PYTHONPATH": os.pathsep.join(paths), "HOOK": name, "SLOW_S": slow_s}


def replay_verdict(*paths: Path) -> dict[str, Any]:
    """Return the verdict of a replay of the files of one recording, without the digest of its content."""
    row = replay_files([str(path) for path in paths], __version__)
    del row["sha256"]
    return row


def stored_lines(out: Path) -> list[bytes]:
    """Return the whole lines of the stored verdicts."""
    path = out / "verdicts.jsonl"
    return [line for line in path.read_bytes().splitlines(True) if line.endswith(b"\n")] if path.exists() else []


def await_lines(out: Path, count: int, process: Any) -> None:
    """Wait until a process has stored `count` verdicts."""
    while len(stored_lines(out)) < count:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)


def test_exactly_the_bad_recordings_are_named(report):
    require_exact(report, list(BAD))
    rows = bad_rows(report)
    assert (rows["drive"]["tick"], rows["drive"]["column"]) == (DRIVE_TICK, "x_drive_v")
    assert rows["coefficient"]["column"] == "x_position_um"
    assert report["counts"]["identical"] == GOOD
    assert (report["recordings"], report["pending"], report["stored"]) == (GOOD + len(BAD), 0, 0)


def test_two_workers_give_the_same_answer(folder, report):
    code, other_report = archive("replay", str(folder / "**/*.mcap"), "--jobs", 2, folder=folder)
    assert (code, other_report["verdicts"], other_report["counts"]) == (1, report["verdicts"], report["counts"])


def test_the_table_has_the_bad_recordings_alone(folder):
    process = rtloop("archive", "replay", folder, folder=folder)
    output, errors = process.communicate(timeout=200)
    lines = output.splitlines()
    assert [line.split()[0] for line in lines[1 : 1 + len(BAD)]] == sorted(
        str(path.relative_to(folder)) for path in folder.rglob("*.mcap") if path.stem in BAD
    ), errors
    assert lines[1 + len(BAD)].startswith(f"{GOOD + len(BAD)} recordings: {GOOD} identical, 3 damaged, ")
    assert "recordings/s" in lines[-1]


def test_an_archive_of_good_recordings_ends_with_0(good_recording, tmp_path):
    make_archive(tmp_path / "archive", good_recording, 3, [])
    assert archive("replay", tmp_path / "archive", folder=tmp_path)[0] == 0
    code, report = archive("info", tmp_path / "archive", folder=tmp_path)
    assert (code, report["counts"]) == (0, {"readable": 3})
    row = report["verdicts"][0]
    assert (row["ticks"], row["duration_s"], row["lost"], row["trips"]) == (3000, pytest.approx(0.3), 0, [])


def test_info_names_the_recordings_that_are_damaged_or_cannot_be_read(folder):
    code, report = archive("info", folder, folder=folder)
    verdicts = {name: row["verdict"] for name, row in bad_rows(report, "readable").items()}
    assert code == 1
    assert verdicts == {"flipped": "damaged", "cut": "damaged", "zeroed": "damaged", "text": "cannot be read"}


def test_a_call_whose_coordinator_was_killed_continues(folder, report, tmp_path):
    out, environment = tmp_path / "out", hook_environment(tmp_path, "no such name", SLOW_S)
    process = rtloop("archive", "replay", folder, "--out", out, folder=tmp_path, environment=environment)
    await_lines(out, 5, process)
    os.kill(process.pid, signal.SIGKILL)  # The workers notice the kill, and end.
    process.communicate(timeout=60)
    before = [line for line in stored_lines(out) if json.loads(line)["verdict"] not in REPEATED]
    code, continued = archive("replay", folder, "--out", out, folder=tmp_path)
    after = stored_lines(out)
    assert (code, continued["verdicts"], continued["stored"]) == (1, report["verdicts"], len(before))
    assert after[: len(before)] == before
    assert len({json.loads(line)["path"] for line in after}) == len(after) == GOOD + len(BAD)
    _, again = archive("replay", folder, "--out", out, folder=tmp_path)
    # A recording that cannot be read, or whose law is of another version, is tried again.
    assert (again["verdicts"], again["stored"]) == (report["verdicts"], GOOD + len(BAD) - 2)
    assert sorted(stored_lines(out)) == sorted(after)


@pytest.mark.soak
def test_ctrl_c_lets_the_recordings_end_and_the_same_command_continues(folder, report, tmp_path):
    out, environment = tmp_path / "out", hook_environment(tmp_path, "no such name", SLOW_S)
    process = rtloop("archive", "replay", folder, "--out", out, folder=tmp_path, environment=environment)
    await_lines(out, 2, process)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=100)
    assert (process.returncode, "Traceback" in errors) == (130, False), errors
    assert "run the same command again" in errors
    assert archive("replay", folder, "--out", out, folder=tmp_path)[1]["verdicts"] == report["verdicts"]


def test_a_recording_that_kills_its_worker_is_named_and_no_other(folder, report, tmp_path):
    environment = hook_environment(tmp_path, "run-003")
    code, other_report = archive("replay", folder, "--jobs", 2, folder=tmp_path, environment=environment)
    rows = bad_rows(other_report)
    assert (code, rows.pop("run-003")["verdict"]) == (1, "crashed its worker")
    assert rows == bad_rows(report)
    assert other_report["recordings"] == len(other_report["verdicts"]) == GOOD + len(BAD)


@pytest.mark.soak
def test_dask_workers_give_the_same_answer(folder, report, tmp_path):
    pytest.importorskip("distributed")
    with dask_cluster(tmp_path, 2) as address:
        code, other_report = archive("replay", folder, "--scheduler", address, folder=tmp_path)
    assert (code, other_report["verdicts"]) == (1, report["verdicts"]), other_report


def test_a_changed_recording_is_replayed_again_and_a_torn_line_does_not_count(good_recording, tmp_path):
    out, archive_folder = tmp_path / "out", tmp_path / "archive"
    make_archive(archive_folder, good_recording, 4, [])
    archive("replay", archive_folder, "--out", out, folder=tmp_path)
    flip_tick_byte(good_recording, archive_folder / "day-1/run-001.mcap")
    lines = stored_lines(out)
    other_version = lines[2].replace(f'"rtloop": "{__version__}"'.encode(), b'"rtloop": "0.0.1"')
    (out / "verdicts.jsonl").write_bytes(lines[0] + lines[1] + other_version + lines[3][:40])
    code, report = archive("replay", archive_folder, "--out", out, folder=tmp_path)
    stored = sum(b"run-001" not in line for line in lines[:2])
    assert (code, report["stored"], report["counts"]) == (1, stored, {"identical": 3, "damaged": 1})
    assert archive("replay", archive_folder, "--out", out, folder=tmp_path)[1]["stored"] == 4


def test_the_files_of_a_rotated_run_are_one_recording(tmp_path):
    record(tmp_path / "run.mcap", eventful_configuration(), 25_000, rotate_s=1.0)
    (complete,) = find_recordings([tmp_path])
    assert [Path(path).name for path in complete.paths] == [f"run-000{number}.mcap" for number in (1, 2, 3)]
    assert replay_verdict(*map(Path, complete.paths)) == {"verdict": "identical", "reason": ""}
    changed_ns = complete.mtime_ns + 1_000_000_000
    os.utime(complete.paths[1], ns=(changed_ns, changed_ns))
    assert find_recordings([tmp_path]) == [complete._replace(mtime_ns=changed_ns)]
    (tmp_path / "run-0001.mcap").unlink()
    (remaining,) = find_recordings([tmp_path])
    assert replay_verdict(*map(Path, remaining.paths)) == {
        "verdict": "identical",
        "reason": "file 1 of the run is missing",
    }


def test_numbered_copies_are_recordings_of_their_own(good_recording, tmp_path):
    for name in ("copy-0001.mcap", "copy-0002.mcap"):
        shutil.copy(good_recording, tmp_path / name)
    assert [len(recording.paths) for recording in find_recordings([tmp_path])] == [1, 1]


def test_a_leftover_is_unfinished_unless_its_recovered_file_exists(good_recording, tmp_path):
    for name in ("left.mcap.part", "recovered.mcap.part", "recovered.mcap"):
        shutil.copy(good_recording, tmp_path / name)
    code, report = archive("replay", tmp_path, folder=tmp_path)
    assert [(Path(row["path"]).name, row["verdict"]) for row in report["verdicts"]] == [
        ("left.mcap.part", "unfinished"),
        ("recovered.mcap", "identical"),
    ]
    assert (code, "rtloop recover" in report["verdicts"][0]["reason"]) == (1, True)


def test_a_damaged_index_is_named_although_all_ticks_are_identical(good_recording, tmp_path):
    flip_byte(good_recording, good_recording.stat().st_size - 100, tmp_path / "run.mcap")
    row = replay_verdict(tmp_path / "run.mcap")
    assert (row["verdict"], "all ticks are identical" in row["reason"]) == ("damaged", True)


def test_a_later_format_is_another_version(good_recording, tmp_path):
    change_header(good_recording, tmp_path / "run.mcap", format=99)
    for judge in (replay_files, summarise_files):
        row = judge([str(tmp_path / "run.mcap")], __version__)
        assert (row["verdict"], row["reason"].startswith("header of the recording")) == ("other version", True)


def test_an_import_has_no_law(tmp_path):
    (tmp_path / "scan.csv").write_text("t,u,y\n" + "".join(f"{k / 1000},{k % 7},{k % 5}\n" for k in range(100)))
    assert run("import", tmp_path / "scan.csv", "--time", "t", "--all").exit_code == 0
    assert replay_verdict(tmp_path / "scan.mcap")["verdict"] == "no law"
    assert summarise_files([str(tmp_path / "scan.mcap")], __version__)["verdict"] == "readable"


def test_a_worker_of_another_version_is_refused(good_recording):
    with pytest.raises(UnavailableError, match=r"a worker process has rtloop .*; allowed: 99\.0"):
        replay_files([str(good_recording)], "99.0")


@pytest.mark.parametrize("pattern", ["none/*.mcap", "empty", "none.mcap"])
def test_a_pattern_without_a_recording_is_refused(pattern, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match=f"^{pattern.replace('*', '.')}: "):
        find_recordings([Path(pattern)])


@pytest.fixture
def shared(good_recording) -> Iterator[Path]:
    """An archive that all users may read, except one of its folders."""
    folder = Path(mkdtemp(dir="/tmp"))
    make_archive(folder, good_recording, 2, [])
    folder.chmod(0o755)
    (folder / "day-1").chmod(0o700)
    yield folder
    shutil.rmtree(folder)


@ROOT_ONLY
def test_a_folder_that_cannot_be_read_is_named(shared):
    closed = str(shared / "day-1")

    def examine() -> list[str]:
        lists = [find_recordings([pattern]) for pattern in (shared, shared / "**/*.mcap")]
        recordings = [
            recording for recording_list in lists for recording in recording_list if recording.paths[0] == closed
        ]
        return [replay_files(recording.paths, __version__)["reason"] for recording in recordings]

    assert as_user(VICTIM, examine) == ["Permission denied"] * 2


def test_a_folder_takes_the_verdicts_of_one_process_at_a_time(tmp_path):
    with (
        open_table([], (), tmp_path, "verdicts.jsonl"),
        pytest.raises(UnavailableError, match="another `rtloop archive`"),
    ):
        open_table([], (), tmp_path, "verdicts.jsonl").__enter__()


def test_ticks_without_a_snapshot_are_not_verified_and_a_file_without_an_end_is_damaged(tmp_path):
    base, path = record_bases(tmp_path)[0], tmp_path / "run.mcap"
    path.write_bytes(pack_file(drop_snapshots(base, {0, 1})))
    row = replay_verdict(path)
    assert (row["verdict"], "no earlier snapshot" in row["reason"]) == ("not verified", True)
    path.write_bytes(pack_file(drop_chunks(base, len(base.chunks) - 1)))
    for row in (replay_verdict(path), summarise_files([str(path)], __version__)):
        assert (row["verdict"], "no recorded end" in row["reason"]) == ("damaged", True)


class WorkersHere:
    """Workers that run each function in the test's process, at once."""

    count, name = 1, "this process"

    def submit(self, function: Any, *arguments: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(function(*arguments))
        return future

    def explain(self, error: BaseException) -> BaseException:
        return error

    def recover(self) -> None:
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError


class StoredArchive:
    """An archive below `folder`, whose verdicts are stored."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.out = folder, folder / "out"

    def examine(self, examination: Examination = REPLAY) -> tuple[int, list[str]]:
        """Examine the archive. Returns the number of stored rows that count, and all verdicts."""
        recordings = find_recordings([self.folder])
        report = examine(examination, recordings, WorkersHere(), self.out, lambda _: None, lambda: False)
        return report["stored"], [row["verdict"] for row in report["verdicts"]]


@pytest.fixture
def stored(good_recording, tmp_path) -> StoredArchive:
    """An archive of two recordings with stored verdicts, both identical."""
    for name in ("a.mcap", "b.mcap"):
        shutil.copy(good_recording, tmp_path / name)
    archive = StoredArchive(tmp_path)
    assert archive.examine() == (0, ["identical"] * 2)
    assert archive.examine() == (2, ["identical"] * 2)
    return archive


def change_unnoticed(path: Path, data: bytes) -> None:
    """Write other bytes of equal length into a file, with its old times."""
    before = path.stat()
    assert len(data) == before.st_size
    path.write_bytes(data)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.mark.parametrize("place", [0.001, 0.3, 0.5, 0.9, 0.9999])
@pytest.mark.parametrize("examination", [REPLAY, INFO], ids=["replay", "info"])
def test_a_stored_verdict_does_not_count_after_a_flipped_bit(place: float, examination, stored: StoredArchive):
    """The size and the times are those of the file that was examined."""
    stored.examine(examination)
    path = stored.folder / "b.mcap"
    data = bytearray(path.read_bytes())
    data[int(place * len(data))] ^= 16
    change_unnoticed(path, bytes(data))
    count, verdicts = stored.examine(examination)
    assert (count, verdicts[0]) == (1, examination.good_verdict)
    assert verdicts[1] == examination.function([str(path)], __version__, None)["verdict"]


def test_a_stored_verdict_counts_for_equal_content_alone(good_recording, stored: StoredArchive, tmp_path):
    first, second = stored.folder / "a.mcap", stored.folder / "b.mcap"
    os.utime(second, (1, 1))
    assert stored.examine() == (2, ["identical"] * 2)
    changed = tmp_path / "changed"
    flip_tick_byte(good_recording, changed)
    for replace_file in (os.link, os.symlink):
        first.unlink()
        replace_file(changed, first)
        assert stored.examine() == (1, ["damaged", "identical"])
        first.unlink()
        replace_file(second, first)
        assert stored.examine() == (1, ["identical"] * 2)
    first.unlink()
    shutil.move(changed, first)
    stored.examine()
    first.rename(changed)
    second.rename(first)
    changed.rename(second)
    assert stored.examine() == (0, ["identical", "damaged"])


def test_every_file_of_a_rotated_run_is_part_of_its_stored_verdict(tmp_path):
    record(tmp_path / "run.mcap", eventful_configuration(), 25_000, rotate_s=1.0)
    archive = StoredArchive(tmp_path)
    assert (archive.examine(), archive.examine()) == ((0, ["identical"]), (1, ["identical"]))
    for number in (2, 3):
        path = tmp_path / f"run-000{number}.mcap"
        good = path.read_bytes()
        data = bytearray(good)
        data[len(data) // 2] ^= 1
        change_unnoticed(path, bytes(data))
        assert archive.examine() == (0, ["damaged"])
        change_unnoticed(path, good)
        assert archive.examine() == (0, ["identical"])


def test_a_damaged_line_of_the_stored_verdicts_does_not_count(good_recording, stored: StoredArchive):
    flip_tick_byte(good_recording, stored.folder / "b.mcap")
    assert stored.examine() == (1, ["identical", "damaged"])
    path = stored.out / REPLAY.file_name
    whole = path.read_bytes()
    for change in (
        whole.replace(b'"damaged"', b'"identical"'),
        whole.replace(b'"check": "', b'"check": "0'),
        whole[: -len(whole) // 4],
    ):
        assert change != whole
        path.write_bytes(change)
        assert stored.examine()[1] == ["identical", "damaged"]


def test_a_verdict_of_another_version_does_not_count(stored: StoredArchive, monkeypatch):
    monkeypatch.setattr("rtloop.campaigns.archive_table.__version__", "99.0")
    (recording, _) = find_recordings([stored.folder])
    with open_table([recording], REPLAY.columns, stored.out, REPLAY.file_name) as table:
        assert table.stored_sha256(recording) is None


class PoolBrokenOnce:
    """Workers whose pool is broken at the second submission, before any future fails."""

    count, name = 1, "workers"

    def __init__(self) -> None:
        self.submissions, self.recoveries = 0, 0

    def submit(self, function: Any, *arguments: Any) -> Future[Any]:
        self.submissions += 1
        if self.submissions == 2:
            raise BrokenProcessPool
        future: Future[Any] = Future()
        future.set_result(function(*arguments))
        return future

    def explain(self, error: BaseException) -> BaseException:
        return WorkerDied() if isinstance(error, BrokenProcessPool) else error

    def recover(self) -> None:
        self.recoveries += 1

    def close(self) -> None:
        raise NotImplementedError


@pytest.mark.parametrize("alone", [True, False])
def test_a_pool_that_is_broken_at_a_submission_costs_no_item(alone):
    class Doubling:
        """Job that doubles numbers and stores the results."""

        def __init__(self) -> None:
            self.results: dict[int, int] = {}

        def submit(self, items: tuple[Any, ...]) -> Future[Any]:
            return workers.submit(lambda number: 2 * number, items[0])

        def store(self, items: tuple[Any, ...], result: Any) -> None:
            self.results[items[0]] = result

        def set_aside(self, item: Any) -> None:
            raise AssertionError(item)

    workers, job = PoolBrokenOnce(), Doubling()
    done = Dispatcher(workers, job).run([Task((k,), alone) for k in range(5)], lambda _: None, lambda: False)
    assert (done, job.results) == (5, {k: 2 * k for k in range(5)})


def test_a_rewritten_recording_leaves_no_open_file_in_the_worker(good_recording, tmp_path):
    """Each rewritten recording is converted to a temporary copy; an archive may have more than a process may open."""
    path = rewriting.write(tmp_path / "rewritten.mcap", rewriting.messages(good_recording), chunk_size=20_000)
    assert replay_files([str(path)], __version__)["verdict"] == "identical"
    opened = len(os.listdir("/proc/self/fd"))
    for number in range(3):
        copy = tmp_path / f"{number}.mcap"
        copy.write_bytes(path.read_bytes())
        assert replay_files([str(copy)], __version__)["verdict"] == "identical"
    assert len(os.listdir("/proc/self/fd")) == opened
