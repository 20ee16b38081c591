"""Parking where the host refuses a system call: a note is never half written, and an unreadable file is reported."""

from __future__ import annotations

import errno
import os
import resource
import signal
from pathlib import Path
from typing import Any

import pytest

from rtloop.drivers.base import Wiring
from rtloop.drivers.errors import DriverError
from rtloop.drivers.shm import ShmDriver, ShmOptions
from rtloop.engine.memory import SharedBlock, Sizes
from rtloop.errors import OutputError, RtloopError, UnavailableError
from rtloop.hil import board
from rtloop.supervision import parking
from rtloop.supervision.hardware import Hardware, UnreadableNote, read_note, write_note
from rtloop.supervision.parking_account import ParkingAccount
from tests.syscalls.parking import ParkingABoard

WIRING = {"x": Wiring("adc0", "dac0")}


def refuse(*_: object) -> Any:
    """Raise the error of a process that has too many open files."""
    raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))


def test_a_note_that_cannot_be_written_leaves_the_old_one(tmp_path: Path):
    path = tmp_path / "lab.hardware"
    old, new = (Hardware("shm", f'{{"file":"/{name}"}}', WIRING, 1000.0, 500.0, 1.0) for name in ("old", "new"))
    write_note(path, old)
    handler, limits = signal.signal(signal.SIGXFSZ, signal.SIG_IGN), resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
        with pytest.raises(OutputError, match=r"lab\.hardware: .*too large"):
            write_note(path, new)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert read_note(path) == old
    write_note(path, new)
    assert read_note(path) == new
    assert list(tmp_path.iterdir()) == [path]


def test_a_note_that_cannot_be_read_is_not_taken_for_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "lab.hardware"
    assert read_note(path) is None
    write_note(path, Hardware("shm", '{"file":"/old"}', WIRING, 1000.0, 500.0, 1.0))
    monkeypatch.setattr("rtloop.supervision.hardware.open_file", refuse)
    with pytest.raises(UnreadableNote, match=r"lab\.hardware: .*: Too many open files"):
        read_note(path)


def test_a_block_that_cannot_be_read_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "lab.block"
    fd = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    SharedBlock.create(Sizes(1, 1, 1000.0, 8, 1), fd)
    os.close(fd)
    monkeypatch.setattr(os, "pread", refuse)
    with (
        pytest.raises(UnavailableError, match=r"lab\.block: Too many open files"),
        parking._open_last_block(path, ParkingAccount("lab")),
    ):
        pass


def test_a_board_that_cannot_be_mapped_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "board"
    path.write_bytes(bytes(board.file_bytes()))
    path.chmod(0o600)
    monkeypatch.setattr("rtloop.drivers.shm.BoardMemory", refuse)
    driver = ShmDriver(ShmOptions(file=str(path)), WIRING, 1000.0)
    open_before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(DriverError, match="Too many open files"):
        driver.open()
    assert len(os.listdir("/proc/self/fd")) == open_before


def test_an_account_has_each_failure_and_the_exit_code_of_the_first():
    account = ParkingAccount("lab")
    for failure in (DriverError("the card is gone"), OutputError("the note stays")):
        with account.collect_failures():
            raise failure
    with pytest.raises(RtloopError, match="no output was parked\nthe card is gone\nthe note stays") as caught:
        account.result()
    assert caught.value.exit_code == UnavailableError.exit_code


def test_a_board_and_a_block_that_cannot_be_closed_are_parked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Every `close` fails, although Linux frees the descriptor; parking continues to its end."""
    case = ParkingABoard(tmp_path)
    close = os.close

    def close_and_refuse(fd: int) -> None:
        close(fd)
        refuse()

    with monkeypatch.context() as refusing:
        refusing.setattr(os, "close", close_and_refuse)
        assert "parked from" in parking.park_configuration(case.config)
    assert case.written_v()[-1] == 0.0
