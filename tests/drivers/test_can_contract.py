"""A node in a separate process keeps the drivers' contract; its outputs are read from shared memory."""

from __future__ import annotations

import math
import mmap
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import can
import pytest
from can.interfaces.udp_multicast import UdpMulticastBus

from rtloop.drivers.base import Driver, Wiring
from rtloop.drivers.can.driver import CanDriver
from rtloop.drivers.can.node import serve
from rtloop.drivers.contract import DriverCalls, DriverContract
from rtloop.drivers.errors import DriverError
from tests.drivers.bench_driver import open_driver
from tests.drivers.can_bench import free_port, options_on
from tests.drivers.processes import ENVIRONMENT
from tests.faults.evidence import wait_for

ONE_AXIS = {"x": Wiring("adc0", "dac0")}
RATE_HZ = 500.0
WATCHDOG_MS = 1000.0
"""Longer than the host stalls a test: a node whose controller pauses for longer parks its output."""
WITNESS = struct.Struct("<qdq")
PROGRAM = """
import mmap, sys
from rtloop.drivers.can.bus import open_bus
from rtloop.drivers.can.node import RigNode
from tests.drivers.bench_driver import open_driver
from tests.drivers.can_bench import options_on
from tests.drivers.test_can_contract import WATCHDOG_MS, WITNESS

options = options_on(int(sys.argv[1]), watchdog_ms=WATCHDOG_MS)
with open(sys.argv[2], "r+b") as file:
    witness = mmap.mmap(file.fileno(), WITNESS.size)
with open_bus(options) as bus:
    node = RigNode(bus, options, ["x"])
    node.require_alone()
    while True:
        node.step()
        WITNESS.pack_into(witness, 0, node.samples, node.drive_v[0], node.parked)
"""


class Node:
    """A simulated CAN node's process, with a record of its work in shared memory."""

    def __init__(self, folder: Path) -> None:
        self.port, path = free_port(), folder / "witness"
        path.write_bytes(bytes(WITNESS.size))
        with path.open("r+b") as file:
            self._witness = mmap.mmap(file.fileno(), WITNESS.size)
        command = [sys.executable, "-c", PROGRAM, str(self.port), str(path)]
        self.process = subprocess.Popen(command, env=ENVIRONMENT)

    def driver(self, **more: object) -> CanDriver:
        """Return a driver of this node, not yet open."""
        return CanDriver(options_on(self.port, **{"hold_ticks": 100, "wait_s": 60.0} | more), ONE_AXIS, RATE_HZ)

    @property
    def record(self) -> tuple[int, float, int]:
        """Number of samples, output in V, number of parkings by the watchdog."""
        return WITNESS.unpack_from(self._witness)

    def is_waiting(self) -> bool:
        """Return whether the process waits for a message, not for a processor."""
        return Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()[0] == "S"

    def end(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Node]:
    """Yield a node's process that runs for the whole module."""
    node = Node(tmp_path_factory.mktemp("node"))
    yield node
    node.end()


class TestNode(DriverContract):
    @pytest.fixture(autouse=True)
    def _node(self, node: Node) -> None:
        self.node = node

    def driver(self) -> Driver:
        return self.node.driver()

    def outputs(self, driver: Driver) -> Sequence[float] | None:
        """Return the output once the node waits for a message and its record no longer changes."""
        last = None
        while last != (last := self.node.record[:2]) or not self.node.is_waiting():
            time.sleep(0.05)
        return [self.node.record[1]]


def test_a_silent_controller_gets_the_outputs_parked(node):
    with open_driver(node.driver()) as calls:
        before = node.record[2]
        assert calls.write([4.0]) == 0
        wait_for(lambda: node.record[1] == pytest.approx(4.0, abs=2e-4), "the drive")
        wait_for(lambda: node.record[1] == 0.0 and node.record[2] == before + 1, "a parked output")


def test_a_stopped_node_shows_in_status_and_age(node):
    with open_driver(node.driver(hold_ticks=3)) as calls:
        assert calls.read()[0] == 0
        node.process.send_signal(signal.SIGSTOP)
        readings = [calls.read() for _ in range(5) if calls.write([0.0]) == 0]
        node.process.send_signal(signal.SIGCONT)
        assert [status for status, _ in readings] == [1] * 5
        ages = [values[1] for _, values in readings]
        assert ages[0] < ages[1] < ages[2] < math.inf
        assert ages[3:] == [math.inf] * 2
        assert [values[-1] for _, values in readings] == [1, 2, 3, 4, 5]


def test_a_second_controller_is_refused(node):
    ending, message = threading.Event(), r"CAN bus udp_multicast 239\.\d.*: another controller drives this node"

    def drive(calls: DriverCalls) -> None:
        while not ending.wait(0.005):
            calls.write([0.5])

    with open_driver(node.driver()) as calls, ThreadPoolExecutor() as executor:
        executor.submit(drive, calls)
        try:
            with pytest.raises(DriverError, match=message):
                node.driver().open()
        finally:
            ending.set()


def test_an_intruder_fails_the_driver(node):
    driver = node.driver()
    calls = DriverCalls(driver.open(), driver.facts)
    assert (calls.read()[0], calls.write([0.0])) == (0, 0)
    with can.Bus(ignore_config=True, **options_on(node.port).keywords) as bus:
        bus.send(can.Message(arbitration_id=0x100, data=bytes([9, 0, 0, 16]), is_extended_id=False))
    wait_for(lambda: calls.read()[0] == -1, "a failed read")
    assert "another controller drives this node" in str(driver.error)
    wait_for(lambda: node.record[1] == 0.0, "a parked output")
    driver.open()  # the intruder is gone
    driver.close()


def test_a_bus_that_fails_at_its_closing_is_closed(node, monkeypatch: pytest.MonkeyPatch):
    driver, closings = node.driver(), list[int]()
    calls = DriverCalls(driver.open(), driver.facts)
    assert calls.write([3.0]) == 0
    wait_for(lambda: node.record[1] == pytest.approx(3.0, abs=2e-4), "the drive")
    shut_down = UdpMulticastBus.shutdown

    def fail(bus: UdpMulticastBus) -> None:
        shut_down(bus)
        closings.append(1)
        raise can.CanOperationError("the interface is gone")

    monkeypatch.setattr(UdpMulticastBus, "shutdown", fail)
    assert calls.write([0.0]) == 0
    driver.close()  # `close` waits for the answer to the last frame.
    assert closings == [1]
    wait_for(lambda: node.record[1] == 0.0, "a drive of 0 V")
    monkeypatch.undo()
    driver.open()
    driver.close()


def test_a_second_node_is_refused(node):
    with pytest.raises(DriverError, match="another rtloop node is on this bus already"):
        serve(options_on(node.port), ["x"], lambda: True)
