"""Stored machine code: loaded without the compiler, checked for damage, with the exceptions of its kernel."""

from __future__ import annotations

import ctypes
import gc
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from rtloop.foundation.native import cache, machine_code
from rtloop.foundation.native.c_function import CFunction, Entry, ExportedKernel

EXPORTERS = ("rtloop.engine.assembly", *(f"rtloop.drivers.{name}" for name in ("sim", "shm", "comedi", "playback")))
ROOT = Path(__file__).parents[2]
WITHOUT_COMPILER = """
import sys
from importlib import import_module
import rtloop.cli.run
from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.engine import process
from rtloop.recording.capture.recorder import Recorder
from rtloop.recording.views.summary import summarise
from rtloop.supervision.supervisor import Supervisor
from rtloop.configuration.cautions import cautions
from rtloop.engine.memory import SharedBlock

prepared = prepare(load("deploy/paper.toml"))
Recorder(SharedBlock.create(prepared.plan.sizes))
process.rehearse()
print("numba" in sys.modules)
"""


def halved(number):
    """Return half of an even number; raise IndexError for an odd one."""
    if number % 2 != 0:
        raise IndexError("an odd number")
    return number // 2


def doubled(number):
    """Return twice a whole number."""
    return number * 2


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a new folder the cache of compiled code, and return it."""
    monkeypatch.setattr(cache, "CACHE_FOLDER", tmp_path)
    return tmp_path


def record_compilations(kind: type[Entry | CFunction], monkeypatch) -> list[str]:
    """Return a list to which each kernel that is compiled from here on adds its name."""
    names, compile_original = [], kind._compile

    def compile_and_record(kernel):
        names.append(kernel.__name__)
        return compile_original(kernel)

    monkeypatch.setattr(kind, "_compile", compile_and_record)
    return names


def test_a_run_needs_no_compiler() -> None:
    """Command, recorder and loop do not import numba once their kernels are in the cache."""
    for _ in range(2):
        result = subprocess.run([sys.executable, "-c", WITHOUT_COMPILER], cwd=ROOT, capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "False"


def test_all_exported_kernels_are_stored() -> None:
    for module in EXPORTERS:
        import_module(module)
    exported = [item for item in gc.get_objects() if issubclass(type(item), ExportedKernel)]
    kernels = [kernel for kernel in exported if kernel._name.startswith("rtloop.")]
    assert len(kernels) >= 15
    assert [kernel._name for kernel in kernels if not (kernel.address and machine_code.load(kernel._name))] == []


def test_a_kernel_is_compiled_once_and_keeps_its_exceptions(folder, monkeypatch) -> None:
    compiled = record_compilations(Entry, monkeypatch)
    for _ in range(2):
        entry = Entry(halved, "int64(int64)")
        assert entry(14) == 7
        with pytest.raises(IndexError, match="an odd number"):
            entry(13)
    assert compiled == ["halved"]
    assert len(list(folder.glob("*.o"))) == 1


@pytest.mark.parametrize("damage", [lambda data: data[:-1], lambda data: b"", lambda data: data[:99] + b"\0" * 99])
def test_a_damaged_file_is_compiled_again(folder, monkeypatch, damage) -> None:
    compiled = record_compilations(Entry, monkeypatch)
    assert Entry(doubled, "int64(int64)")(4) == 8
    (file,) = folder.glob("*.o")
    file.write_bytes(damage(file.read_bytes()))
    assert Entry(doubled, "int64(int64)")(4) == 8
    assert compiled == ["doubled", "doubled"]


def test_a_c_function_is_called_by_its_address(folder, monkeypatch) -> None:
    compiled = record_compilations(CFunction, monkeypatch)
    for _ in range(2):
        address = CFunction(doubled, "int64(int64)").address
        assert ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64)(address)(21) == 42
    assert compiled == ["doubled"]


def test_a_c_function_that_raises_is_left_to_numba(folder) -> None:
    """Its callers check no status: only numba's own C function reports the exception."""
    assert CFunction(halved, "int64(int64)").address
    assert not list(folder.glob("*.o"))


def test_a_folder_that_cannot_be_written_is_ignored(folder, monkeypatch) -> None:
    monkeypatch.setattr(machine_code, "_path", lambda name: folder / "missing" / name)
    assert Entry(doubled, "int64(int64)")(4) == 8
