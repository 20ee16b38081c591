"""Parking after a service that died: what is done about a loop that outlived it. The loop is a real process."""

import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from typing import ClassVar

import pytest

from drivers.base import Channel, Facts, Wiring
from drivers.python import PythonDriver
from hil.options import Options
from rtloop.engine.memory import SharedBlock, Sizes, Word
from rtloop.errors import UnavailableError
from rtloop.service import parking

SIZES = Sizes(columns=1, axes=1, rate_hz=1000.0, snapshot_bytes=8, table_samples=1)
CLAIM = """
import sys
from rtloop.engine.memory import SharedBlock
block = SharedBlock(int(sys.argv[1]))  # kept: the claim goes with the first descriptor that is closed
block.claim()
print("claimed", flush=True)
sys.stdin.read()
"""


@contextmanager
def a_loop(block):
    """A process that drives `block` until its stdin ends."""
    command = [sys.executable, "-c", CLAIM, str(block.fd)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=[block.fd]) as process:
        assert process.stdout.readline() == b"claimed\n"
        yield process


@pytest.fixture
def block():
    return SharedBlock.create(SIZES)


def test_a_block_knows_who_drives_and_that_he_died(block):
    assert block.driven_by() is None
    with a_loop(block) as loop:
        assert block.driven_by() == loop.pid
        loop.kill()
        loop.wait()
        assert block.driven_by() is None


def test_a_loop_that_ends_by_itself_is_waited_for(block):
    with a_loop(block) as loop:
        threading.Timer(0.05, loop.stdin.close).start()
        parking._await_end(block, 30.0, 1000.0)
    assert loop.returncode == 0


def test_a_loop_that_stands_still_is_killed(block, monkeypatch):
    monkeypatch.setattr(parking, "MARGIN_S", 0.05)
    with a_loop(block) as loop:
        loop.send_signal(signal.SIGSTOP)
        parking._await_end(block, 0.05, 1000.0)
    assert loop.returncode == -signal.SIGKILL


def test_a_service_that_is_alive_is_left_alone(block):
    ended = threading.Event()

    def beat():
        while not ended.wait(0.005):
            block.words[Word.HEARTBEAT_NS] = time.monotonic_ns()

    beating = threading.Thread(target=beat)
    beating.start()
    try:
        with a_loop(block) as loop, pytest.raises(UnavailableError, match=f"process {loop.pid} drives"):
            parking._await_end(block, 30.0, 1000.0)
    finally:
        ended.set()
        beating.join()
    assert loop.returncode == 0


@pytest.mark.parametrize(("parks_itself", "writes"), [(False, [1.5, 1.0, 0.5, 0.0]), (True, [])])
def test_a_card_that_parks_itself_is_not_driven_back(parks_itself, writes):
    """From 2 V at 50 V/s and 100 Hz; a card with a watchdog has left its last drive by the time it is parked."""

    class Card(PythonDriver):
        kind = "card"
        written: ClassVar[list[float]] = []

        @property
        def facts(self):
            return Facts((Channel("in"),), (Channel("out"),), hardware_watchdog=parks_itself)

        def start(self):
            self.written.clear()

        def read(self):
            return [0.0]

        def write(self, volts):
            self.written.extend(volts)

        def stop(self):
            pass

    wiring = {"x": Wiring("in", "out")}
    card = Card(Options(), wiring, 100.0)
    parking.park(card, wiring, ["x"], [2.0], 50.0)
    assert card.written == [*writes, 0.0]  # `close` writes the safe value
