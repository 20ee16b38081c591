"""The driver shm keeps the contract on a board in a separate process; the outputs are read from the board's memory."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from rtloop.drivers.base import Driver, Wiring
from rtloop.drivers.contract import DriverContract
from rtloop.drivers.errors import DriverError
from rtloop.drivers.shm import ShmDriver, ShmOptions
from rtloop.hil.board import LSB_V
from tests.drivers.bench_driver import open_driver
from tests.drivers.processes import ENVIRONMENT, board_memory

ONE_AXIS = {"x": Wiring("adc0", "dac0")}
RATE_HZ = 1000.0
TIMEOUT_S = 250.0
PROGRAM = """
import sys
from pathlib import Path
from rtloop.hil.board import serve
from rtloop.hil.options import BoardOptions
serve(Path(sys.argv[1]), BoardOptions(), ["x"], 1000.0, lambda: False)
"""


def shm(path: Path) -> ShmDriver:
    """Return a driver of the board at `path`, not yet open."""
    return ShmDriver(ShmOptions(file=str(path)), ONE_AXIS, RATE_HZ)


def start_board(path: Path) -> subprocess.Popen[bytes]:
    """Start a board with its memory at `path`, wait until it can be opened, and return its process."""
    board = subprocess.Popen([sys.executable, "-c", PROGRAM, str(path)], env=ENVIRONMENT)
    deadline_s = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline_s:
        try:
            with open_driver(shm(path)):
                return board
        except DriverError:
            time.sleep(0.02)
    board.kill()
    raise AssertionError("the board did not start")


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Yield the path of the memory of a board that runs for the whole module."""
    path = tmp_path_factory.mktemp("board") / "board"
    board = start_board(path)
    yield path
    board.kill()
    board.wait()


class TestBoard(DriverContract):
    @pytest.fixture(autouse=True)
    def _board(self, file: Path) -> None:
        self.file = file

    def driver(self) -> Driver:
        return shm(self.file)

    def outputs(self, driver: Driver) -> Sequence[float] | None:
        return [float(board_memory(self.file).dac_codes[0]) * LSB_V]


def test_a_paused_board_shows_in_the_sample_age(tmp_path):
    board = start_board(tmp_path / "board")
    with open_driver(shm(tmp_path / "board")) as calls:
        board.send_signal(signal.SIGSTOP)
        ages_us = []
        for _ in range(2):
            time.sleep(0.05)
            ages_us.append(calls.read()[1][1])
        assert 0 < ages_us[0] <= ages_us[1] - 50_000 * 0.99
    board.kill()
    board.wait()
