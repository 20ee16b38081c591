"""Parts of the supervisor: text of a process's end, folders and file names, a child that does not die."""

from __future__ import annotations

import os
import subprocess
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rtloop.configuration.file import load, parse
from rtloop.configuration.prepare import prepare
from rtloop.errors import OutputError
from rtloop.supervision import child as child_module
from rtloop.supervision.child import Child
from rtloop.supervision.description import recording_header
from rtloop.supervision.host_delay import store_host_delay
from rtloop.supervision.paths import SYSTEM_FOLDER, runtime_folder
from rtloop.supervision.recording_path import new_recording_path
from rtloop.supervision.supervisor import _ending_text

ROOT = Path(__file__).resolve().parents[2]
PAPER = ROOT / "deploy" / "paper.toml"


@pytest.mark.parametrize(
    ("code", "text"), [(0, "exit code 0"), (73, "exit code 73"), (-1, "signal 1"), (-9, "signal 9")]
)
def test_an_end_is_told_as_a_signal_or_an_exit_code(code: int, text: str) -> None:
    assert _ending_text(code) == text


def test_recordings_of_the_same_second_are_numbered_from_2(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder is created with its parent folders; the name of an unfinished recording is in use, too, and so are
    the files that a recorder with rotation numbers, whatever the quota has left of them.
    """
    monkeypatch.setattr("time.strftime", lambda form, _: "20260101T120000")
    prepared, folder = prepare(load(PAPER), paced=False), tmp_path / "of" / "today"
    names = []
    for end in (".mcap", ".mcap.part", "-0001.mcap.part", "-0007.mcap", ".mcap"):
        path = new_recording_path(prepared, folder)
        names.append(path.name)
        path.with_name(path.stem + end).touch()
    stem = f"{prepared.plan.name}-20260101T120000"
    assert names == [f"{stem}.mcap", *(f"{stem}-{number}.mcap" for number in (2, 3, 4, 5))]
    assert folder.is_dir()


def test_a_folder_for_recordings_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot create the folder for recordings"):
        new_recording_path(prepare(load(PAPER), paced=False), tmp_path / "file" / "below")


def test_a_header_says_whether_every_tick_is_recorded() -> None:
    complete, windowed = (
        recording_header(prepare(parse(PAPER.read_text() + text, "test", PAPER.parent, "test"), paced=False), {})
        for text in ("", '\n[recording.around]\non = ["trip"]\nbefore_s = 1.0\nafter_s = 1.0\n')
    )
    assert (complete["format"], windowed["format"]) == (1, 2)
    assert ("around" in complete and complete["around"] is not None, windowed["around"]["on"]) == (False, ("trip",))


@pytest.mark.parametrize("user", [0, 1000])
def test_only_root_has_the_folder_of_the_system(user: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: user)
    monkeypatch.setattr(os, "getuid", lambda: user)
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    assert (runtime_folder() == SYSTEM_FOLDER) == (user == 0)
    monkeypatch.setenv("RUNTIME_DIRECTORY", f"{tmp_path}:/elsewhere")
    assert runtime_folder() == tmp_path


def test_a_measured_delay_that_cannot_be_stored_is_an_error_with_the_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "file" / "below"))
    with pytest.raises(OutputError, match=r"below.*Not a directory"):
        store_host_delay(load(PAPER), lateness_us=40.0)


def test_a_child_that_outlives_its_signal_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process may hang in the kernel, for example in a driver; in this test no signal is sent."""
    monkeypatch.setattr(child_module, "END_TIMEOUT_S", 0.2)
    process = subprocess.Popen(["sleep", "60"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    child: Any = SimpleNamespace(
        process=process, kill=lambda: None, _reader=SimpleNamespace(join=lambda timeout_s: None)
    )
    child.wait, child.close_stdin = partial(Child.wait, child), partial(Child.close_stdin, child)
    try:
        assert not Child.end(cast(Child, child))
    finally:
        process.kill()
        process.wait()
    assert Child.end(cast(Child, child))
