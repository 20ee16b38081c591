"""Accidents around a node in a separate process: dead and rival masters, garbage, a loop that stands still."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import rtloop
from rtloop.drivers.errors import DriverError
from rtloop.drivers.node.driver import NodeDriver
from tests.drivers.bench_driver import open_driver
from tests.drivers.node_bench import NodeProcess
from tests.drivers.processes import ENVIRONMENT
from tests.drivers.processes import rtloop as start_rtloop
from tests.faults.evidence import wait_for
from tests.stage_text import one_axis

pytestmark = pytest.mark.system

PATIENT = {"watchdog_ms": 5000.0, "error_limit": 1_000_000, "hold_ticks": 1000}
MASTERS = 8
DEAD_MASTER = """
import json, os, signal, sys
from rtloop.drivers.contract import DriverCalls
from tests.drivers.node_bench import ONE_AXIS, make_options
from rtloop.drivers.node.driver import UdpDriver

options, writes = json.loads(sys.argv[1]), json.loads(sys.argv[2])
driver = UdpDriver(make_options("udp", options), ONE_AXIS, 500.0)
calls = DriverCalls(driver.open(), driver.facts)
calls.read()
for volts in writes:
    calls.write([volts])
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NodeProcess]:
    """Yield a node's process on UDP that runs for the whole module."""
    node = NodeProcess("udp", tmp_path_factory.mktemp("node"))
    yield node
    node.end()


def run_dying_master(node: NodeProcess, writes: list[float], watchdog_ms: float) -> None:
    """Run a master that opens the node, reads, writes some volts, and dies by SIGKILL."""
    options = json.dumps(node.options | {"watchdog_ms": watchdog_ms, "wait_s": 60.0})
    command = [sys.executable, "-c", DEAD_MASTER, options, json.dumps(writes)]
    assert subprocess.run(command, env=ENVIRONMENT, check=False).returncode == -signal.SIGKILL


def test_a_master_that_dies_before_its_first_write_leaves_safe_outputs_and_a_free_node(node):
    parkings = node.parkings
    run_dying_master(node, [5.0], 300.0)  # An earlier master leaves an output that is not safe.
    run_dying_master(node, [], 200.0)
    wait_for(lambda: abs(node.settled_output_v()) < 1e-5, "a safe output")
    assert node.parkings == parkings + 1
    with open_driver(node.driver(**PATIENT)) as calls:
        assert calls.read()[0] == 0
        assert abs(node.settled_output_v()) < 1e-5


def test_of_eight_masters_at_once_one_drives_undisturbed_and_the_others_are_told(node):
    outcomes: dict[int, NodeDriver | str] = {}
    barrier = threading.Barrier(MASTERS)

    def master(number: int) -> None:
        driver = node.driver(**PATIENT)
        barrier.wait()
        try:
            driver.open()
            outcomes[number] = driver
        except DriverError as error:
            outcomes[number] = str(error)

    for _ in range(2):  # The second round shows that refused masters leave no state in the node.
        outcomes.clear()
        threads = [threading.Thread(target=master, args=(number,)) for number in range(MASTERS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        winners = [outcome for outcome in outcomes.values() if isinstance(outcome, NodeDriver)]
        assert [outcome for outcome in outcomes.values() if isinstance(outcome, str)] == [
            f"UDP 127.0.0.1 port {node.options['port']}: another controller drives this node; stop the other controller"
        ] * (MASTERS - 1)
        winners[0].close()


def test_a_master_that_drives_is_never_evicted(node):
    driver = node.driver(**PATIENT)
    with open_driver(driver) as calls:
        calls.read()
        calls.write([2.0])
        for _ in range(2):
            with pytest.raises(DriverError, match="another controller drives this node"):
                node.driver(**PATIENT).open()
            wait_for(lambda: calls.read()[0] == 0, "an answer")
            assert node.settled_output_v() == pytest.approx(2.0, abs=1e-5)
            calls.write([2.0])
        assert driver.error is None


def flood(ports: list[int], is_ended: threading.Event) -> int:
    """Send garbage and beginnings of frames to ports of this computer until `is_ended`; return their number."""
    chance, count = random.Random(1), 0
    contents = [chance.randbytes(n) for n in (0, 1, 7, 32, 36, 200, 1400)] + [b"\x7b\x05\x72\x01" + bytes(28)]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        while not is_ended.is_set():
            for port in ports:
                sender.sendto(contents[count % len(contents)], ("127.0.0.1", port))
                count += 1
    return count


def local_port(driver: NodeDriver) -> int:
    """Return the local port of an open driver of kind `udp`."""
    assert driver._link is not None
    with socket.socket(fileno=os.dup(driver._link.fd)) as copy:
        return copy.getsockname()[1]


def test_a_flood_of_garbage_to_both_ports_moves_nothing_and_ends_nothing(node):
    driver = node.driver(rate_hz=2000.0, **PATIENT)
    with open_driver(driver) as calls:
        calls.read()
        is_ended = threading.Event()
        thread = threading.Thread(target=flood, args=([local_port(driver), node.options["port"]], is_ended))
        thread.start()
        statuses, values, start_s = [], list[float](), time.monotonic()
        for tick in range(1000):
            calls.write([0.001 * tick])
            time.sleep(max(0.0, start_s + (tick + 1) / 2000 - time.monotonic()))
            status, values = calls.read()
            statuses.append(status)
        is_ended.set()
        thread.join()
        assert driver.error is None
        assert set(statuses) <= {0, 1}
        assert values[2 + 4] > 0  # foreign frames
        calls.write([3.0])
        wait_for(lambda: (calls.read()[0], calls.write([3.0])) == (0, 0), "an answer after the flood")
        assert node.settled_output_v() == pytest.approx(3.0, abs=1e-5)


CONFIG = """
[loop]
rate_hz = 100
mode = "raw"
[driver]
kind = "udp"
host = "127.0.0.1"
port = {port}
watchdog_ms = 1000.0
hold_ticks = 1000
error_limit = 1000000
wait_s = 60.0
[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 10.0
"""


def test_the_screen_and_the_recording_say_in_words_that_the_watchdog_bit(node, tmp_path: Path):
    config = tmp_path / "node.toml"
    axis = one_axis() + "[axis.interlocks]\nsample_age_us = 1e9\n"
    reference = '[axis.reference]\nkind = "hold"\nvalue = 1.0\n'
    config.write_text(CONFIG.format(port=node.options["port"]) + axis + reference)
    parkings = node.parkings
    run = start_rtloop("run", config, "--duration", "600", "--out", tmp_path / "out")
    wait_for(lambda: node.output_v == pytest.approx(1.0, abs=1e-5), "the drive")
    loops = child_processes(run.pid)
    for pid in loops:
        os.kill(pid, signal.SIGSTOP)
    wait_for(lambda: node.parkings == parkings + 1, "the watchdog")
    for pid in loops:
        os.kill(pid, signal.SIGCONT)
    output, errors = run.communicate(timeout=120)
    reason = "no drive reached the node for longer than watchdog_ms, and the node's watchdog has parked the outputs"
    assert reason in " ".join((output + errors).split())
    assert run.returncode == 69
    assert abs(node.settled_output_v()) < 1e-5
    events = rtloop.load(next((tmp_path / "out").glob("*.mcap"))).events
    assert any(event["kind"] == "driver_failed" for event in events)
    assert reason in str(events)


def child_processes(pid: int) -> list[int]:
    """Return the ids of the processes that a process and its threads have started."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return [int(child) for task in tasks for child in (task / "children").read_text().split()]
