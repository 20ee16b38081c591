"""A folder that a group shares: its members record there; no file is read or written through a link of another user."""

from __future__ import annotations

import os
import shutil
import signal
import stat
import tempfile
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py  # noqa: F401  (These three are imported once, instead of in each process of another user.)
import numpy as np
import pyarrow.parquet  # noqa: F401
import pytest
import scipy.io  # noqa: F401

from rtloop.design.identification.model_sections import write_new_file
from rtloop.design.identification.plots import save_figure
from rtloop.errors import OutputError, RtloopError
from rtloop.interchange.columns import ColumnSelection
from rtloop.interchange.export import export
from rtloop.interchange.formats.table import Table
from rtloop.interchange.importing import import_data
from rtloop.recording.cutting.cut import cut
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.recover import find_leftovers, recover
from rtloop.recording.file.writer import Writer
from rtloop.recording.load import load
from rtloop.recording.views.page import write_page
from rtloop.starters.law import law_files
from rtloop.starters.new_files import write_new_files
from rtloop.supervision.quota import Quota
from rtloop.workbench.written_files import write_output
from tests.recording.hand_made_loop import START_UNIX_NS, final_message, make_header, make_rows, write_recording
from tests.users import ATTACKER, ROOT_ONLY, VICTIM, Raised, as_user

GROUP = 54323
PRECIOUS = b"the only copy"
TIMEOUT_S = 20


@pytest.fixture(autouse=True)
def fail_after_timeout() -> Iterator[None]:
    """Turn an open that never returns into a failure."""

    def give_up(*_: object) -> None:
        raise AssertionError(f"still waiting after {TIMEOUT_S} s")

    previous = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(TIMEOUT_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous)


@pytest.fixture
def shared() -> Iterator[Path]:
    """A folder of mode 2775, in which all members of GROUP may write."""
    parent = Path(tempfile.mkdtemp())
    parent.chmod(0o755)
    yield make_group_folder(parent / "shared")
    shutil.rmtree(parent)


def make_group_folder(folder: Path) -> Path:
    """Make a folder in which all members of GROUP may write. Returns its path."""
    folder.mkdir()
    os.chown(folder, 0, GROUP)
    folder.chmod(0o2775)
    return folder


@pytest.fixture
def precious(shared: Path) -> Path:
    """A file that only the victim may write."""
    path = shared.parent / "precious"
    path.write_bytes(PRECIOUS)
    os.chown(path, VICTIM, VICTIM)
    path.chmod(0o600)
    return path


def call_as_member(uid: int, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in a process of a member of the group, with umask 002. Returns its result."""

    def as_member() -> Any:
        os.umask(0o002)
        return function(*arguments)

    return as_user(uid, as_member, groups=(GROUP,))


def write_short(path: Path) -> str:
    """Write a recording of 1,000 ticks. Returns its path."""
    return str(write_recording(path, make_rows(1_000)))


def begin_recording(path: Path) -> Writer:
    """Begin a recording and write 1,000 ticks. Returns its writer."""
    writer = Writer(path, make_header(), START_UNIX_NS)
    writer.write_ticks(make_rows(1_000))
    return writer


def leave_unfinished(path: Path) -> None:
    """Write an unfinished file, as a recorder that died leaves it."""
    begin_recording(path).close()


def import_scan(folder: Path) -> Any:
    """Import a table of two columns as `scan.mcap`."""
    table = Table({"time": np.arange(100) * 1e-3, "drive": np.arange(100.0)}, {"time": "s", "drive": "V"}, "time")
    return import_data(folder / "scan.csv", ColumnSelection(all=True), table=table)


FIGURE = SimpleNamespace(savefig=lambda file, **_: file.write(b"png"))
WRITERS: dict[str, Callable[[Path], Any]] = {
    "run.mcap.part.new": lambda folder: write_recording(folder / "run.mcap", make_rows(100)),
    "cut.mcap.cutting.new": lambda folder: cut(folder / "old.mcap", output=folder / "cut.mcap"),
    "old-recovered.mcap.recovering.new": lambda folder: recover(folder / "old.mcap"),
    "scan.mcap.importing.new": import_scan,
    **{
        f"old.{end}{part}": lambda folder, to=to: export(folder / "old.mcap", to)
        for to, end in (("csv", "csv"), ("npz", "npz"), ("mat", "mat"), ("hdf5", "h5"), ("parquet", "parquet"))
        for part in ("", ".part")
    },
    "old.html": lambda folder: write_page(folder / "old.mcap"),
    "fit.png": lambda folder: save_figure(FIGURE, folder / "fit.png"),
    "design.toml": lambda folder: write_output(folder / "design.toml", b"new"),
    "found.toml": lambda folder: write_new_file(folder / "found.toml", "new"),
    "lead.py": lambda folder: write_new_files(folder, law_files("lead")),
}
"""Functions that write each file in a folder with old.mcap and scan.csv."""


@pytest.fixture(scope="module")
def old(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 1,000 ticks, which the writers read."""
    return write_recording(tmp_path_factory.mktemp("old") / "old.mcap", make_rows(1_000))


def writer_exit_codes(shared: Path, old: Path, place_file: Callable[[Path], None]) -> dict[str, int]:
    """Run each writer after `place_file` has put a file in its place. Returns exit codes by name; 0: it wrote."""
    for name in WRITERS:
        folder = make_group_folder(shared / name.replace(".", "_"))
        shutil.copy(old, folder / "old.mcap")
        (folder / "scan.csv").touch()
        place_file(folder / name)

    def write_all() -> dict[str, int]:
        codes = {}
        for name, write in WRITERS.items():
            folder = shared / name.replace(".", "_")
            codes[name] = 0
            try:
                write(folder)
            except RtloopError as error:
                codes[name] = error.exit_code
                if not str(error).startswith(str(folder)) or "\n" in str(error):
                    raise
        return codes

    return call_as_member(VICTIM, write_all)


def as_attacker(place_file: Callable[[Path], Any]) -> Callable[[Path], None]:
    """Return a function that calls `place_file` and gives the file to the attacker."""

    def place_as_attacker(path: Path) -> None:
        place_file(path)
        os.chown(path, ATTACKER, GROUP, follow_symlinks=False)

    return place_as_attacker


@ROOT_ONLY
@pytest.mark.parametrize("target", ["precious", "new"])
def test_no_file_is_written_through_a_link_of_another_user(shared: Path, old: Path, precious: Path, target: str):
    place_file = as_attacker(lambda path: path.symlink_to(precious.with_name(target)))
    assert writer_exit_codes(shared, old, place_file) == dict.fromkeys(WRITERS, OutputError.exit_code)
    assert (precious.read_bytes(), precious.with_name("new").exists()) == (PRECIOUS, False)


@ROOT_ONLY
def test_a_file_of_another_user_is_not_overwritten(shared: Path, old: Path):
    def place_file(path: Path) -> None:
        path.write_bytes(b"theirs")
        path.chmod(0o666)

    assert writer_exit_codes(shared, old, as_attacker(place_file)) == dict.fromkeys(WRITERS, OutputError.exit_code)
    assert all((shared / name.replace(".", "_") / name).read_bytes() == b"theirs" for name in WRITERS)


@ROOT_ONLY
def test_a_file_with_two_names_keeps_its_content(shared: Path, old: Path, precious: Path):
    codes = writer_exit_codes(shared, old, lambda path: os.link(precious, path))
    assert precious.read_bytes() == PRECIOUS
    assert {name for name, code in codes.items() if not code} == {
        name for name in WRITERS if name.endswith((".new", ".part"))
    }


@ROOT_ONLY
def test_a_file_of_the_same_user_is_overwritten(shared: Path, old: Path):
    def place_file(path: Path) -> None:
        path.write_bytes(b"ours, and longer than what comes")
        os.chown(path, VICTIM, GROUP)

    codes = writer_exit_codes(shared, old, place_file)
    overwritten = {
        "old.html",
        "fit.png",
        "design.toml",
        *(name for name in WRITERS if name.endswith((".new", ".part"))),
    }
    assert {name for name, code in codes.items() if not code} == overwritten
    assert (shared / "design_toml" / "design.toml").read_bytes() == b"new"


@ROOT_ONLY
def test_no_recording_is_begun_through_a_folder_that_another_user_linked(shared: Path, precious: Path):
    private_folder = precious.with_name("own")
    private_folder.mkdir()
    os.chown(private_folder, VICTIM, VICTIM)
    call_as_member(ATTACKER, lambda: (shared / "recordings").symlink_to(private_folder))
    with pytest.raises(Raised) as caught:
        call_as_member(VICTIM, write_short, shared / "recordings" / "run.mcap")
    assert (caught.value.exit_code, os.listdir(private_folder)) == (OutputError.exit_code, []), caught.value.message
    assert f"user {ATTACKER}" in caught.value.message


@ROOT_ONLY
def test_members_of_a_group_can_use_each_others_recordings(shared: Path):
    first, second = shared / "first.mcap", shared / "second.mcap"
    for path, uid in ((first, VICTIM), (second, ATTACKER)):
        call_as_member(uid, write_short, path)
        status = path.stat()
        assert (status.st_uid, status.st_gid, stat.S_IMODE(status.st_mode)) == (uid, GROUP, 0o644)
    call_as_member(VICTIM, leave_unfinished, shared / "third.mcap")
    for use in (
        lambda: recover(shared / "third.mcap.part"),
        lambda: cut(second, output=shared / "cut.mcap"),
        lambda: export(second, "csv", shared / "mine.csv"),
    ):
        assert call_as_member(VICTIM, use)["ticks"] == 1_000
    status = (shared / "mine.csv").stat()
    assert (status.st_gid, stat.S_IMODE(status.st_mode)) == (GROUP, 0o664)
    for _ in range(2):  # The second file replaces the first.
        call_as_member(VICTIM, lambda: str(write_page(second, shared / "mine.html")))
        call_as_member(VICTIM, lambda: write_output(shared / "design.toml", b"new"))
    assert call_as_member(ATTACKER, lambda: len(load(first))) == 1_000


def test_a_pipe_among_unfinished_recordings_does_not_block(tmp_path: Path):
    pipes = [tmp_path / "pipe.mcap.part", tmp_path / "pipe.mcap"]
    for pipe in pipes:
        os.mkfifo(pipe)
    leave_unfinished(tmp_path / "run.mcap")
    assert find_leftovers(tmp_path) == [tmp_path / "run.mcap.part"]
    for pipe, use in product(pipes, (recover, load)):
        with pytest.raises(RecordingError, match=r"pipe\.mcap.*: not a regular file"):
            use(pipe)


@ROOT_ONLY
def test_unfinished_recordings_of_other_users_are_only_recovered_by_name(shared: Path, precious: Path):
    private = precious.with_name("private")
    private.mkdir()
    os.chown(private, VICTIM, VICTIM)
    for uid, path in ((VICTIM, private / "secret"), (VICTIM, shared / "own"), (ATTACKER, shared / "theirs")):
        call_as_member(uid, leave_unfinished, path.with_suffix(".mcap"))
    call_as_member(ATTACKER, lambda: (shared / "laid.mcap.part").symlink_to(private / "secret.mcap.part"))
    assert call_as_member(VICTIM, lambda: [path.name for path in find_leftovers(shared)]) == ["own.mcap.part"]
    assert call_as_member(VICTIM, lambda: recover(shared / "theirs.mcap.part")["ticks"]) == 1_000


@ROOT_ONLY
def test_a_recorder_writes_no_file_that_replaces_its_own(shared: Path, precious: Path):
    def record() -> tuple[bool, list[str]]:
        writer = begin_recording(shared / "run.mcap")
        writer.part.rename(shared / "away")
        writer.part.symlink_to(precious)
        is_replaced = not writer.file.is_in_place()
        with pytest.raises(OutputError, match="was removed"):
            writer.write_ticks(make_rows(1_000, first=1_000))
        with pytest.raises(OutputError, match="was removed"):
            writer.finish(lambda logged: final_message(logged, logged))
        return is_replaced, sorted(os.listdir(shared))

    assert call_as_member(VICTIM, record) == (True, ["away", "run.mcap.part"])
    assert precious.read_bytes() == PRECIOUS


@ROOT_ONLY
def test_a_quota_counts_and_removes_no_file_of_another_user(shared: Path):
    names = [f"test-2025010{day}T000000.mcap" for day in range(1, 4)]
    for name in names[1:]:
        call_as_member(VICTIM, write_short, shared / name)
    call_as_member(ATTACKER, lambda: shutil.copyfile(shared / names[1], shared / names[0]) and None)
    call_as_member(ATTACKER, lambda: os.truncate(shared / names[0], 1 << 40))

    def removed() -> tuple[list[str], int]:
        quota = Quota(shared, "test", 1 << 30, 0)
        return [removal.file.name for removal in quota.enforce()], quota.total_bytes

    assert call_as_member(VICTIM, removed) == ([], sum((shared / name).stat().st_size for name in names[1:]))
