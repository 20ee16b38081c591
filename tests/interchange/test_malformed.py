"""Files that are damaged, contradict themselves or are much too large get a message of one line, in little memory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from scipy.io import savemat

from rtloop.interchange import isolated_reader
from rtloop.interchange.formats import from_mat
from rtloop.interchange.formats.table import Hints, UnreadableData
from rtloop.interchange.reading import read_in_process

HUGE = 2 << 30
MEMORY_MIB = 400
"""Limit of the memory of a process that refuses all bad files; the libraries alone take 200 MiB."""


def write_sparse_file(path: Path, head: bytes = b"") -> None:
    """Write a file of 2 GiB that takes no disk space behind `head`."""
    with path.open("wb") as file:
        file.write(head)
        file.truncate(HUGE)


@pytest.fixture
def bad_files(tmp_path: Path) -> dict[str, str]:
    """A folder of bad files: the expected messages by file name."""
    savemat(tmp_path / "good.mat", {"t": np.arange(1000.0), "u": np.arange(1000.0)})
    valid = (tmp_path / "good.mat").read_bytes()
    (tmp_path / "good.mat").unlink()
    (tmp_path / "cut.mat").write_bytes(valid[:5000])
    (tmp_path / "junk.mat").write_bytes(valid[:128] + b"\x07" * 500)
    (tmp_path / "words.mat").write_bytes(b"hello there")
    write_sparse_file(tmp_path / "zeros.mat")
    write_sparse_file(tmp_path / "hole.mat", valid[:128])
    write_sparse_file(tmp_path / "claim.mat", valid[:128] + np.array([14, HUGE - 136], "<u4").tobytes())
    write_sparse_file(tmp_path / "zeros.csv")
    write_sparse_file(tmp_path / "hole.csv", b"t,u\n" + b"0,1\n" * 1000)
    write_sparse_file(tmp_path / "zeros.h5", b"\x89HDF\r\n\x1a\n")
    with h5py.File(tmp_path / "claim.h5", "w") as file:
        file.create_dataset("x", (1 << 28,), "f8", chunks=(1 << 16,))
    write_sparse_file(tmp_path / "zeros.npz", b"PK\x03\x04")
    write_sparse_file(tmp_path / "zeros.parquet", b"PAR1")
    (tmp_path / "empty.csv").write_bytes(b"")
    (tmp_path / "folder.mat").mkdir()
    return {
        "cut.mat": "cut off: the element at byte 128 ends beyond the end of the file",
        "junk.mat": "no element of a MAT file at byte 128",
        "words.mat": "not a MAT file",
        "zeros.mat": "not a MAT file",
        "hole.mat": "no element of a MAT file at byte 128",
        "claim.mat": "contains more than 1 GiB",
        "zeros.csv": "neither text nor another known kind",
        "hole.csv": "neither text nor another known kind",
        "zeros.h5": "not an HDF5 file",
        "claim.h5": "x: the file's numbers take more than 1 GiB",
        "zeros.npz": "not an npz file",
        "zeros.parquet": "not a Parquet file",
        "empty.csv": "empty",
        "folder.mat": "Is a directory",
    }


def test_each_damaged_file_is_refused_in_a_line_and_in_bounded_memory(bad_files: dict[str, str], tmp_path: Path):
    command = [sys.executable, "-W", "error", "-m", __name__, *(str(tmp_path / name) for name in bad_files)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.stderr == ""
    *lines, memory = result.stdout.splitlines()
    assert len(lines) == len(bad_files)
    for line, (name, message) in zip(lines, bad_files.items(), strict=True):
        assert line.startswith(f"{tmp_path / name}: ")
        assert message in line
    assert int(memory) < MEMORY_MIB


def test_an_element_too_large_when_expanded_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    savemat(tmp_path / "scan.mat", {"x": np.zeros(1 << 20)}, do_compression=True)
    assert (tmp_path / "scan.mat").stat().st_size < 1 << 16
    assert read_in_process(tmp_path / "scan.mat").columns["x"].size == 1 << 20
    monkeypatch.setattr(from_mat, "MAX_BYTES", 1 << 22)
    monkeypatch.setattr(scipy.io, "loadmat", lambda *_, **__: pytest.fail("it is not to be read"))
    with pytest.raises(UnreadableData, match="contains more than"):
        read_in_process(tmp_path / "scan.mat")


def test_a_library_that_crashes_is_an_error_of_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "sitecustomize.py").write_text("import os\nos.kill(os.getpid(), 11)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(UnreadableData, match=r"scan.mat: the file is damaged; .* \(SIGSEGV\)"):
        isolated_reader.read_table(tmp_path / "scan.mat")


def test_a_killed_reader_is_no_fault_of_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    reader = tmp_path / "reader"
    reader.write_text("#!/bin/sh\nkill -9 $$\n")
    reader.chmod(0o700)
    monkeypatch.setattr(isolated_reader.sys, "executable", str(reader))
    with pytest.raises(UnreadableData, match=r"scan\.mat: the process that read the file was killed; free some memory"):
        isolated_reader.read_table(tmp_path / "scan.mat")


def test_an_isolated_process_reads_the_same(tmp_path: Path):
    numbers = np.random.default_rng(3).normal(size=100_000)
    savemat(tmp_path / "scan.mat", {"t": np.arange(100_000.0), "u": numbers})
    table, expected = isolated_reader.read_table(tmp_path / "scan.mat"), read_in_process(tmp_path / "scan.mat")
    assert {name: values.tobytes() for name, values in table.columns.items()} == {
        name: values.tobytes() for name, values in expected.columns.items()
    }
    assert (table.time, dict(table.about)) == (expected.time, dict(expected.about))
    with pytest.raises(UnreadableData, match="no group 'x'"):
        isolated_reader.read_table(tmp_path / "scan.mat", Hints("x"))


def main() -> None:
    """Print the error of each file given, and then the peak memory of this process in MiB."""
    for name in sys.argv[1:]:
        try:
            read_in_process(Path(name))
        except UnreadableData as error:
            print(str(error).replace("\n", "⏎"))
    # ru_maxrss would begin with the value of the parent process.
    status = Path("/proc/self/status").read_text()
    print(int(status.partition("VmHWM:")[2].split()[0]) >> 10)


if __name__ == "__main__":
    main()
