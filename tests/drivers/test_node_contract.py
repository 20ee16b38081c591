"""A node in a separate process keeps the drivers' contract, behind UDP and behind a serial line."""

from __future__ import annotations

import contextlib
import math
import signal
import time
from collections.abc import Iterator, Sequence

import pytest

from rtloop.drivers.base import Driver, Wiring
from rtloop.drivers.contract import DriverCalls, DriverContract
from rtloop.drivers.errors import DriverError
from rtloop.drivers.node.driver import SerialDriver, UdpDriver
from rtloop.drivers.node.options import UdpOptions
from tests.drivers.bench_driver import open_driver
from tests.drivers.node_bench import NodeProcess, make_key, make_options
from tests.faults.evidence import wait_for

pytestmark = pytest.mark.system

PATIENT = {"watchdog_ms": 5000.0, "error_limit": 100_000, "hold_ticks": 1000}
"""Limits so wide that a short stall of this machine fails no test."""


@pytest.fixture(scope="module", params=["udp", "udp with a key", "serial with a key"])
def node(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[NodeProcess]:
    """Yield a node's process, on UDP or on a serial line, that runs for the whole module."""
    folder = tmp_path_factory.mktemp("node")
    kind, _, has_key = request.param.partition(" ")
    node = NodeProcess(kind, folder, **({"key": make_key(folder)} if has_key else {}))
    yield node
    node.end()


class TestNextTick(DriverContract):
    tolerance_v = 1e-5
    answer = "next tick"

    @pytest.fixture(autouse=True)
    def _node(self, node: NodeProcess) -> None:
        self.node = node

    def driver(self) -> Driver:
        return self.node.driver(answer=self.answer, deadline_us=1e6, **PATIENT)

    def outputs(self, driver: Driver) -> Sequence[float] | None:
        return [self.node.settled_output_v()]


class TestSameTick(TestNextTick):
    answer = "same tick"


def test_a_silent_controller_gets_the_outputs_parked_and_cannot_go_on(node):
    with open_driver(node.driver(**PATIENT | {"watchdog_ms": 200.0})) as calls:
        before = node.parkings
        assert calls.read()[0] >= 0
        assert calls.write([4.0]) == 0
        wait_for(lambda: node.output_v == pytest.approx(4.0, abs=1e-5), "the drive")
        wait_for(lambda: abs(node.output_v) < 1e-5 and node.parkings == before + 1, "a parked output")
        calls.read()
        calls.write([4.0])
        assert abs(node.settled_output_v()) < 1e-5
        wait_for(lambda: calls.read()[0] < 0, "a driver that has failed")


def test_the_reason_of_a_failure_is_told(node):
    driver = node.driver(**PATIENT | {"watchdog_ms": 100.0})
    with open_driver(driver) as calls:
        calls.read()
        assert driver.error is None
        calls.write([1.0])
        time.sleep(0.3)
        calls.write([1.0])
        wait_for(lambda: calls.read()[0] < 0, "a driver that has failed")
    assert driver.error is None  # a closed driver has no error


def test_a_stopped_node_shows_in_status_and_age(node):
    with open_driver(node.driver(**PATIENT | {"hold_ticks": 3})) as calls:
        assert calls.read()[0] == 0
        node.process.send_signal(signal.SIGSTOP)
        readings = [calls.read() for _ in range(5) if calls.write([0.0]) == 0]
        node.process.send_signal(signal.SIGCONT)
        assert [status for status, _ in readings] == [1] * 5
        ages = [values[1] for _, values in readings]
        assert ages[0] < ages[1] < ages[2] < math.inf
        assert ages[3:] == [math.inf] * 2
        assert [values[-3:-1] for _, values in readings] == [[n, 2 * n] for n in range(1, 6)]


def test_a_node_that_stops_before_the_first_tick_is_named_and_the_age_is_that_of_its_last_answer(node):
    driver, start_s = node.driver(**PATIENT), time.monotonic()
    with open_driver(driver) as calls:
        node.process.send_signal(signal.SIGSTOP)
        status, values = calls.read()
        node.process.send_signal(signal.SIGCONT)
        assert status < 0
        assert "does not answer" in str(driver.error)
        assert 0 <= values[1] <= (time.monotonic() - start_s) * 1e6


def test_missing_answers_end_the_exchange_at_the_error_limit(node):
    driver = node.driver(**PATIENT | {"error_limit": 10})
    with open_driver(driver) as calls:
        assert calls.read()[0] == 0
        node.process.send_signal(signal.SIGSTOP)
        statuses = [calls.read()[0] for _ in range(6) if calls.write([0.0]) == 0]
        reason = driver.error
        node.process.send_signal(signal.SIGCONT)
        assert statuses == [1, 1, 1, 1, -1, -1]
        assert "too many ticks without an answer in time" in str(reason)


def test_a_restarted_node_ends_the_exchange(node):
    driver = node.driver(**PATIENT)
    calls = DriverCalls(driver.open(), driver.facts)
    assert calls.read()[0] == 0
    calls.write([3.0])
    wait_for(lambda: node.output_v == pytest.approx(3.0, abs=1e-5), "the drive")
    node.end()
    node.start()
    wait_for(lambda: node.steps > 0, "a node that has started again")
    wait_for(lambda: calls.write([3.0]) == 0 and calls.read()[0] < 0, "a driver that has failed")
    assert "restarted" in str(driver.error)
    assert abs(node.settled_output_v()) < 1e-5
    ending = (
        contextlib.nullcontext()
        if node.kind == "udp"
        else pytest.raises(DriverError, match="until the node's watchdog")
    )
    with ending:  # The serial terminal ended with the first process.
        driver.close()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"inputs": 2}, "the node has 1 inputs; driver.inputs is 2"),
        ({"digital_outputs": 3}, "the node has 0 digital outputs; driver.digital_outputs is 3"),
        ({"output_range_v": [-5.0, 5.0]}, r"driver.output_range_v is \(?\[-5.0, 5.0\]"),
        ({"safe_v": 1.0}, "parks output 0 at .* V; driver.safe_v is 1"),
    ],
)
def test_a_node_with_other_channels_is_refused(node, more, message):
    with pytest.raises(DriverError, match=message):
        node.driver(**more).open()


def test_a_rate_that_the_node_does_not_allow_is_refused(node):
    if node.kind == "serial":
        pytest.skip("a serial line has a lower limit of its own")
    with pytest.raises(DriverError, match="the node allows at most 100000 Hz"):
        node.driver(rate_hz=200_000.0).open()


def test_a_missing_node_is_named_with_what_to_do():
    options = UdpOptions(host="127.0.0.1", port=9, wait_s=0.2)
    driver = UdpDriver(options, {"x": Wiring("adc0", "dac0")}, 1000.0)
    with pytest.raises(DriverError, match=r"UDP 127.0.0.1 port 9: no node has answered within 0.2 s; .*--udp"):
        driver.open()


def test_a_missing_terminal_is_named(tmp_path):
    options = make_options("serial", {"device": str(tmp_path / "none"), "wait_s": 0.1})
    with pytest.raises(DriverError, match="No such file or directory; plug the node in"):
        SerialDriver(options, {"x": Wiring("adc0", "dac0")}, 1000.0).open()


@pytest.mark.parametrize("answer", ["next tick", "same tick"])
def test_exchanges_are_measured_with_the_outputs_at_their_safe_values(node, answer):
    driver = node.driver(answer=answer)
    exchanges = driver.measure_exchanges(50)
    assert len(exchanges.durations_us) + exchanges.lost == 50
    assert 0 < min(exchanges.durations_us) < 100_000
    assert abs(node.settled_output_v()) < 1e-5


def test_a_same_tick_node_adds_no_tick_and_a_next_tick_node_one(node):
    assert [node.driver(answer=answer).facts.delay_ticks for answer in ("same tick", "next tick")] == [0, 1]
