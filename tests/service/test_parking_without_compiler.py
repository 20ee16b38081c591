"""Parking needs no compiler: with an empty or damaged cache of compiled code, the writes are the same."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rtloop.drivers.base import Wiring
from rtloop.drivers.comedi import ComediDriver, ComediOptions, comedi_read, comedi_write
from rtloop.drivers.shm import ShmDriver, ShmOptions, shm_write
from rtloop.drivers.sim import SimDriver, sim_read, sim_write
from rtloop.engine.memory import SharedBlock, Sizes
from rtloop.foundation.native import machine_code
from rtloop.foundation.native.c_function import CFunction
from rtloop.foundation.native.uncompiled import allow_uncompiled
from rtloop.hil.options import RigOptions
from rtloop.supervision.parking import park
from tests.drivers.comedi_board import new_board, output_v, stub_library
from tests.faults.configuration import on_a_board
from tests.service.fake_board import FakeBoard

pytestmark = pytest.mark.system

START_V = 6.66
PROGRAM = """
import sys
from rtloop.cli import main
try:
    main(["park", sys.argv[1]])
finally:
    print("imported:", *sys.modules)
"""
SIZES = Sizes(columns=1, axes=1, rate_hz=1000.0, snapshot_bytes=8, table_samples=1)


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, FakeBoard]:
    """Return the configuration and the board of a service that died and left its shared block."""
    (tmp_path / "run").mkdir(mode=0o700)
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    config = tmp_path / "lab.toml"
    config.write_text(on_a_board(tmp_path))
    fd = os.open(tmp_path / "run" / "lab.block", os.O_RDWR | os.O_CREAT, 0o600)
    SharedBlock.create(SIZES, fd)
    os.close(fd)
    return config, FakeBoard(tmp_path / "board", START_V)


def run_park(config: Path) -> tuple[str, set[str]]:
    """Run `rtloop park` as a process, and return its stderr and the names of the modules that it imported."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(config.parent / "cache")}
    command = [sys.executable, "-c", PROGRAM, str(config)]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "Traceback" not in result.stderr
    return result.stderr, {*result.stdout.partition("imported:")[2].split()}


def test_no_compiler_is_imported_whatever_the_cache_holds(lab: tuple[Path, FakeBoard]):
    """At first there is no cache; then its files of the driver's functions are empty."""
    config, board = lab
    message, modules = run_park(config)
    assert "numba" not in modules
    assert "scipy" not in modules
    assert "parked from 6.660 V" in message
    assert board.outputs_v == [0.0]
    (cache,) = (config.parent / "cache" / "rtloop").iterdir()
    for name in ("shm_read", "shm_write"):
        (cache / f"rtloop.drivers.shm.{name}.o").write_bytes(b"")
    message, modules = run_park(config)
    assert "numba" not in modules
    assert "the cache of compiled code is damaged" in message
    assert message.count("\n") == 2
    assert "parked from 0.000 V" in message


def test_the_writes_are_the_same_with_machine_code_and_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """All codes at the output are equal, for random voltages, also out of range, and for the ramp."""
    assert shm_write.address  # compiled, or loaded from the cache
    boards = [FakeBoard(tmp_path / name, -3.3) for name in ("compiled", "uncompiled")]
    for board, name in zip(boards, ("compiled", "uncompiled"), strict=True):
        if name == "uncompiled":
            monkeypatch.setattr(shm_write, "_machine_code", None)
            monkeypatch.setattr(machine_code, "load", lambda name: None)
        driver = ShmDriver(ShmOptions(file=str(tmp_path / name)), {"x": Wiring("adc0", "dac0")}, 4000.0)
        with allow_uncompiled():
            assert (shm_write.address == shm_write._python_callback[1]) == (name == "uncompiled")
            pointers = driver.open()
        write = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p)(pointers.write)
        for volts in np.random.default_rng(1).uniform(-11.0, 11.0, 200):
            assert write(pointers.context, np.array([volts]).ctypes.data) == 0
        driver.close()
        board.start_v = -3.3
        park(driver, 500.0)
    np.testing.assert_array_equal(boards[0].path_v, boards[1].path_v)
    assert len(boards[0].path_v) > 200


def test_a_kernel_that_raises_as_it_is_written_fails(monkeypatch: pytest.MonkeyPatch):
    """A driver's write that raised must not look like a successful write."""

    def broken(context, values):
        raise ZeroDivisionError

    monkeypatch.setattr(machine_code, "load", lambda name: None)
    function = CFunction(broken, "int32(voidptr, CPointer(float64))")
    with allow_uncompiled():
        assert function(0, 0) < 0


def test_a_process_that_has_parked_compiles_as_ever(monkeypatch: pytest.MonkeyPatch):
    """Only parking runs kernels uncompiled: they would be far too slow for a loop."""

    def doubled(number):
        return number * 2

    monkeypatch.setattr(machine_code, "load", lambda name: None)
    monkeypatch.setattr(CFunction, "_compile", lambda self: 4711)
    function = CFunction(doubled, "int64(int64)")
    with allow_uncompiled():
        assert function(21) == 42
        assert function.address != 4711
    assert function.address == 4711


@pytest.mark.parametrize("driver_kind", ["comedi", "sim"])
def test_other_drivers_park_as_they_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, driver_kind: str):
    """The comedi board has its output at 7 V; the other driver is the rig's."""
    monkeypatch.setattr(machine_code, "load", lambda name: None)
    monkeypatch.setattr(CFunction, "_compile", lambda self: pytest.fail("compiled"))
    for function in (comedi_read, comedi_write, sim_read, sim_write):
        monkeypatch.setattr(function, "_machine_code", None)
    wiring = {"x": ComediDriver.example if driver_kind == "comedi" else SimDriver.example}
    if driver_kind == "sim":
        assert park(SimDriver(RigOptions(), wiring, 1000.0), 500.0, np.array([0.02])) == [0.0]
        return
    options = ComediOptions(device=str(new_board(tmp_path / "comedi0")), library=str(stub_library()))
    (from_v,) = park(ComediDriver(options, wiring, 1000.0), 500.0)
    assert from_v == pytest.approx(7.0, abs=1e-3)
    assert output_v(tmp_path / "comedi0", 0) == pytest.approx(0.0, abs=1e-3)
