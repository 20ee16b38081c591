"""A board in a process of its own keeps the drivers' contract, and what its card did is read from the board."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from rtloop.drivers.base import Driver, Wiring
from rtloop.drivers.contract import DriverCalls, DriverContract
from rtloop.drivers.errors import DriverError
from rtloop.drivers.shm import ShmDriver, ShmOptions
from rtloop.hil.board import LSB_V, BoardMemory

ROOT = Path(__file__).resolve().parents[2]
ONE = {"x": Wiring("adc0", "dac0")}
RATE_HZ = 1000.0
TIMEOUT_S = 60.0
PROGRAM = """
import sys
from pathlib import Path
from rtloop.hil.board import serve
from rtloop.hil.options import BoardOptions
serve(Path(sys.argv[1]), BoardOptions(), ["x"], 1000.0, lambda: False)
"""


def start_board(path: Path) -> subprocess.Popen[bytes]:
    """A running board at `path`."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    board = subprocess.Popen([sys.executable, "-c", PROGRAM, str(path)], env=environment)
    deadline_s = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline_s:
        try:
            driver = ShmDriver(ShmOptions(file=str(path)), ONE, RATE_HZ)
            driver.open()
            driver.close()
            return board
        except DriverError:
            time.sleep(0.02)
    board.kill()
    raise AssertionError("the board did not start")


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The memory of a board that runs for the whole module."""
    path = tmp_path_factory.mktemp("board") / "board"
    board = start_board(path)
    yield path
    board.kill()
    board.wait()


def memory_of(path: Path) -> BoardMemory:
    fd = os.open(path, os.O_RDWR)
    try:
        return BoardMemory(fd)
    finally:
        os.close(fd)


class TestBoard(DriverContract):
    @pytest.fixture(autouse=True)
    def _board(self, file: Path) -> None:
        self.file = file

    def driver(self) -> Driver:
        return ShmDriver(ShmOptions(file=str(self.file)), ONE, RATE_HZ)

    def outputs(self, driver: Driver) -> Sequence[float] | None:
        return [float(memory_of(self.file).dac_codes[0]) * LSB_V]


def test_a_second_controller_is_refused_in_another_process(file):
    driver = ShmDriver(ShmOptions(file=str(file)), ONE, RATE_HZ)
    driver.open()
    program = (
        "import sys; from tests.drivers.test_shm_contract import *\n"
        "try: ShmDriver(ShmOptions(file=sys.argv[1]), ONE, RATE_HZ).open()\n"
        "except DriverError as error: print(error)"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", program, str(file)], env=environment, capture_output=True, text=True)
    driver.close()
    assert done.stdout.strip() == f"{file}: another controller drives this board"


def test_a_paused_board_shows_in_the_sample_age(tmp_path):
    board = start_board(tmp_path / "board")
    driver = ShmDriver(ShmOptions(file=str(tmp_path / "board")), ONE, RATE_HZ)
    calls = DriverCalls(driver.open(), driver.facts)
    board.send_signal(signal.SIGSTOP)
    time.sleep(0.05)
    first = calls.read()[1][1]
    time.sleep(0.05)
    second = calls.read()[1][1]
    assert 0 < first < second
    assert second - first >= 50_000 * 0.99
    driver.close()
    board.kill()
    board.wait()


def test_no_board_is_said_with_what_to_do(tmp_path):
    driver = ShmDriver(ShmOptions(file=str(tmp_path / "nothing")), ONE, RATE_HZ)
    with pytest.raises(DriverError, match="No such file or directory; start the board with `rtloop hil serve CONFIG`"):
        driver.open()
    (tmp_path / "text").write_text("no board")
    driver = ShmDriver(ShmOptions(file=str(tmp_path / "text")), ONE, RATE_HZ)
    with pytest.raises(DriverError, match="not a board's memory"):
        driver.open()
