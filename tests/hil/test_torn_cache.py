"""The cache of compiled code after a power cut: damaged files are named, renamed, compiled again, and never run."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rtloop.foundation.native import cache_files
from tests.full_pipe import fill

KERNEL = """
from rtloop.foundation.native.compiled import jit


@jit
def doubled(number):
    return number * 2
"""
PROGRAM = """
import sys
sys.path.insert(0, sys.argv[1])
from kernel import doubled
print(doubled(21), sum(doubled.stats.cache_hits.values()))
"""
DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "half": lambda data: data[: len(data) // 2],
    "zeros": lambda data: bytes(len(data)),
    "one bit": lambda data: data[:-200] + bytes([data[-200] ^ 1]) + data[-199:],
    "somebody's": lambda data: b"\x80\x05N.",
}


def run(folder: Path) -> tuple[str, str]:
    """Run a process that calls the kernel; return its output, the result and the cache's hits, and its stderr."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder / "cache")}
    command = [sys.executable, "-c", PROGRAM, str(folder)]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout.strip(), result.stderr


def test_a_damaged_file_is_named_renamed_and_compiled_again(tmp_path: Path):
    """First the index is empty, then one bit of the code is wrong: neither file is used."""
    (tmp_path / "kernel.py").write_text(KERNEL)
    assert run(tmp_path) == ("42 0", "")
    for suffix, damage in ((".nbi", "empty"), (".nbc", "one bit")):
        (path,) = (tmp_path / "cache").rglob(f"*{suffix}")
        torn = DAMAGE[damage](path.read_bytes())
        path.write_bytes(torn)
        printed, complaint = run(tmp_path)
        assert printed == "42 0"
        assert complaint.count("\n") == 1
        assert f"the cache of compiled code is damaged: {path}" in complaint
        assert Path(f"{path}{cache_files.DAMAGED}").read_bytes() == torn
    assert run(tmp_path) == ("42 1", "")


@pytest.mark.parametrize("damage", DAMAGE)
def test_only_a_whole_file_is_read(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, damage: str
):
    path = tmp_path / "code.o"
    assert cache_files.read(path) is None
    monkeypatch.setattr(cache_files, "_quarantined", [])
    cache_files.write(path, b"machine code" * 100)
    assert cache_files.read(path) == b"machine code" * 100
    assert capfd.readouterr().err == ""
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    assert cache_files.damaged_files(tmp_path) == [path]
    assert cache_files.read(path) is None
    assert str(path) in capfd.readouterr().err
    assert not path.exists()
    assert cache_files.damaged_files(tmp_path) == []
    assert cache_files.quarantined_files(tmp_path) == [Path(f"{path}{cache_files.DAMAGED}")]


def test_a_writer_that_dies_leaves_the_file_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Just before the rename the file does not exist, and its content is on the disk already."""
    path, synced = tmp_path / "code.o", list[int]()

    def die(source: str, target: Path) -> None:
        assert os.stat(source).st_ino in synced
        assert not path.exists()
        raise SystemExit

    monkeypatch.setattr(os, "fsync", lambda fd: synced.append(os.fstat(fd).st_ino))
    monkeypatch.setattr(os, "replace", die)
    with pytest.raises(SystemExit):
        cache_files.write(path, b"machine code")


@pytest.mark.parametrize("place", ["missing/code.o", "folder"])
def test_a_file_that_cannot_be_stored_is_omitted(tmp_path: Path, place: str):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "file").touch()
    cache_files.write(tmp_path / place, b"machine code")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder"]


def test_a_full_or_closed_pipe_at_stderr_does_not_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The warning is lost, and parking continues."""
    reading, writing = os.pipe()
    fill(writing)
    monkeypatch.setattr(cache_files, "STDERR", writing)
    for end in (reading, writing):
        monkeypatch.setattr(cache_files, "_quarantined", [])
        (tmp_path / "code.o").write_bytes(b"")
        assert cache_files.read(tmp_path / "code.o") is None
        os.close(end)
