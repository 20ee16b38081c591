"""The driver `udp` behind a network that loses, delays, reorders, doubles, damages and forges datagrams by a plan.

The oracle, `expected_counts`, counts the relay's arrivals by the definitions in docs/drivers.md; the driver's counts
must be the same in each tick.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest

from rtloop.drivers.base import Wiring
from rtloop.drivers.contract import DriverCalls
from rtloop.drivers.node.card import OBSERVED
from rtloop.drivers.node.driver import UdpDriver
from rtloop.drivers.node.options import UdpOptions
from tests.drivers.lossy_relay import Relay, relayed
from tests.drivers.network_plan import DAMAGES, Copy, Plan, Script
from tests.drivers.node_bench import make_key
from tests.drivers.node_calls import open_calls
from tests.drivers.relay_frames import Arrival
from tests.drivers.relayed_nodes import LibraryNode, PythonNode
from tests.node.accounts import COUNTS, expected_counts

pytestmark = pytest.mark.system

TICKS = 400
PATIENT = {"error_limit": 1_000_000, "watchdog_ms": 5000.0, "wait_s": 60.0}
AnyNode = PythonNode | LibraryNode


@pytest.fixture(params=["Python", "C"])
def node(request: pytest.FixtureRequest) -> AnyNode:
    """Return a node without a line and without a key: the simulated node, then the C library."""
    return PythonNode() if request.param == "Python" else LibraryNode(request.getfixturevalue("library"))


@pytest.fixture(params=["Python", "C"])
def keyed_node(request: pytest.FixtureRequest, tmp_path: Path) -> AnyNode:
    """Return a node without a line and with a key: the simulated node, then the C library."""
    key = make_key(tmp_path)
    return (
        PythonNode(key=key) if request.param == "Python" else LibraryNode(request.getfixturevalue("library"), key=key)
    )


def relay_driver(relay: Relay, **options: object) -> UdpDriver:
    """Return a driver, not yet open, whose node is the relay; it has the node's key."""
    values = {"host": "127.0.0.1", "port": relay.port, "key": relay.node.key} | PATIENT | options
    return UdpDriver(UdpOptions.model_validate(values), {"x": Wiring("adc0", "dac0")}, 1000.0)


def start(driver: UdpDriver) -> DriverCalls:
    """Open a driver, make its first read, and return its calls; retry while a stall of the machine makes it fail."""
    while True:
        calls = open_calls(driver)
        if calls.read()[0] == 0:
            return calls
        assert "does not answer" in str(driver.error)
        driver.close()


class RecordedExchange:
    """An exchange behind a bad network: a different drive in each tick, and the values that the driver returned."""

    def __init__(self, relay: Relay, plan: Plan, hold_ticks: int = 2, ticks: int = TICKS) -> None:
        self.relay, driver = relay, relay_driver(relay, hold_ticks=hold_ticks)
        calls = start(driver)
        self.first = max(relay.drives)
        """Sequence of the newest request before the first tick."""
        relay.begin(plan)
        self.drives_v = {self.first + k: 5.0 * math.sin(0.7 * k) for k in range(1, ticks + 1)}
        results = []
        for volts in self.drives_v.values():
            results.append(calls.read())
            handled = relay.handled
            assert calls.write([volts]) == 0
            relay.wait_handled(handled + 1)
        self.arrivals = [[Arrival("sample", self.first)], *relay.arrivals[: ticks - 1]]
        relay.end()
        driver.close()
        self.statuses = [status for status, _ in results]
        self._rows = np.array([values for _, values in results])

    def column(self, name: str) -> np.ndarray:
        """Return one column (ticks): reading_v, age_us, or an observed signal."""
        return self._rows[:, ("reading_v", "age_us", *OBSERVED).index(name)]


def assert_counts(run: RecordedExchange, hold_ticks: int = 2) -> None:
    """Require the expected counts, status and age in each tick."""
    expected = expected_counts(run.arrivals, run.first)
    for place, name in enumerate(COUNTS):
        assert run.column(name).tolist() == [row[place] for row in expected], name
    held = np.diff([0, *(row[5] for row in expected)])
    assert run.statuses == held.tolist()
    held_in_row = list(accumulate(held, lambda run, is_held: (run + 1) * bool(is_held), initial=0))[1:]
    np.testing.assert_array_equal(np.isinf(run.column("age_us")), np.array(held_in_row) > hold_ticks)


def assert_samples(run: RecordedExchange, node: AnyNode) -> None:
    """Require that each output and each reading has the value of its sequence number."""
    assert run.relay.output_problems == []
    lsb_v = node.volts(1) - node.volts(0)
    assert run.relay.applied
    for sequence, codes in run.relay.applied:
        assert node.volts(codes[0]) == pytest.approx(run.drives_v[sequence], abs=0.51 * lsb_v), sequence
    newest, reading, readings = run.first, (0,), run.column("reading_v")
    for tick, arrived in enumerate(run.arrivals):
        for sample in arrived:
            if sample.kind == "sample" and sample.sequence > newest:
                newest = sample.sequence
                reading = sample.codes
        if newest > run.first:
            assert readings[tick] == pytest.approx(node.volts(reading[0]), abs=0.01 * lsb_v), tick


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_counts_are_what_the_network_did(node, seed):
    with relayed(node) as relay:
        run = RecordedExchange(relay, Plan(seed), hold_ticks=seed)
    assert_counts(run, hold_ticks=seed)
    assert_samples(run, node)
    sent = relay.fates
    assert all(sent[f"{way} {kind}"] for way in ("drive", "sample") for kind in ("lost", "late", "doubled", "good"))


@pytest.mark.parametrize("seed", [4, 5])
def test_damaged_and_forged_datagrams_reach_no_output_and_no_sample(node, seed):
    assert_forgeries_have_no_effect(node, seed)


def test_damaged_and_forged_datagrams_have_no_effect_with_a_key(keyed_node):
    assert_forgeries_have_no_effect(keyed_node, 6)


def assert_forgeries_have_no_effect(node: AnyNode, seed: int) -> None:
    """Run an exchange behind a network that damages and forges, and require the values of the driver's own frames."""
    with relayed(node) as relay:
        RecordedExchange(relay, Plan(0, 0, 0, 0, 0), ticks=20)  # frames of this run are forged in the next one
        before = node.counts[0]
        plan = Plan(seed, damage=0.4, strangers=0.2)
        run = RecordedExchange(relay, plan, ticks=3 * TICKS)  # about ten samples come twice by chance
    assert_counts(run)
    assert_samples(run, node)
    assert all(relay.fates[f"{way} {damage}"] for way in ("drive", "sample") for damage in DAMAGES)
    assert node.counts[0] - before >= sum(relay.fates[f"drive {damage}"] for damage in DAMAGES)
    last = expected_counts(run.arrivals, run.first)[-1]
    assert min(last) > 0


def test_a_good_network_has_no_faults(node):
    with relayed(node) as relay:
        run = RecordedExchange(relay, Script(), ticks=50)
    assert not any(np.any(run.column(name)) for name in COUNTS)
    assert run.statuses == [0] * 50
    assert [sequence for sequence, _ in relay.applied] == list(range(run.first + 1, run.first + 51))


DRIVE_5, SAMPLE_5 = ("drive", 5), ("sample", 5)


@pytest.mark.parametrize(
    ("copies", "counts"),
    [  # lost, late, doubled, invalid, foreign, held
        ({DRIVE_5: ()}, [1, 0, 0, 0, 0, 1]),
        ({SAMPLE_5: ()}, [1, 0, 0, 0, 0, 1]),
        ({DRIVE_5: (Copy(1),)}, [None, None, 0, 0, 0, 1]),
        ({DRIVE_5: (Copy(3),)}, [1, 0, 0, 0, 0, 1]),
        ({SAMPLE_5: (Copy(3),)}, [0, 1, 0, 0, 0, 1]),
        ({DRIVE_5: (Copy(), Copy())}, [0, 0, 0, 0, 0, 0]),
        ({DRIVE_5: (Copy(), Copy(2))}, [0, 0, 0, 0, 0, 0]),
        ({SAMPLE_5: (Copy(), Copy())}, [0, 0, 1, 0, 0, 0]),
        ({SAMPLE_5: (Copy(), Copy(), Copy())}, [0, 0, 2, 0, 0, 0]),
        ({SAMPLE_5: (Copy(3), Copy(4))}, [0, 1, 1, 0, 0, 1]),
        ({DRIVE_5: (Copy(0, "bits"),)}, [1, 0, 0, 0, 0, 1]),
        ({SAMPLE_5: (Copy(0, "bits"),)}, [1, 0, 0, 1, 0, 1]),
        ({SAMPLE_5: (Copy(0, "cut"), Copy())}, [0, 0, 0, 1, 0, 0]),
    ],
)
def test_each_fault_in_each_direction_counts_as_documented(copies, counts):
    node = PythonNode()
    with relayed(node) as relay:
        run = RecordedExchange(relay, Script(copies), ticks=20)
    assert_counts(run)
    for name, count in zip(COUNTS, counts, strict=False):
        assert count is None or run.column(name)[-1] == count, name


@contextmanager
def opened(relay: Relay, **options: object) -> Iterator[tuple[UdpDriver, DriverCalls]]:
    """Yield an open driver behind a relay, and its calls."""
    driver = relay_driver(relay, **options)
    yield driver, start(driver)
    relay.end()
    driver.close()


def exchange(relay: Relay, calls: DriverCalls, volts: float = 1.0) -> tuple[int, list[float]]:
    """Write, wait until the relay has carried the drive, and return the result of a read."""
    handled = relay.handled
    assert calls.write([volts]) == 0
    relay.wait_handled(handled + 1)
    return calls.read()


@pytest.mark.parametrize("limit", [2, 7, 10])
def test_the_error_level_ends_the_exchange_at_its_limit(limit):
    """The level rises by 2 for a lost answer and falls by 1 for an answer: two losses of three end the exchange."""
    with relayed(PythonNode()) as relay, opened(relay, error_limit=limit) as (driver, calls):
        relay.begin(Script({("sample", 3 * i): () for i in range(20)} if limit > 2 else {}))
        statuses = [exchange(relay, calls)[0] for _ in range(60)]
        assert statuses == [1, 0, 0] * 20 if limit > 2 else [0] * 60
        relay.begin(Script({("sample", i): () for i in range(100) if i % 3}))
        level, levels = 0, []
        while not levels or levels[-1] < limit:
            level = level + 2 if len(levels) % 3 else max(level - 1, 0)
            levels.append(level)
        results = [exchange(relay, calls) for _ in levels]
        assert [values[2 + 6] for _, values in results] == levels
        assert [status for status, _ in results] == [int(i % 3 > 0) for i in range(len(levels) - 1)] + [-1]
        assert "too many ticks without an answer in time" in str(driver.error)


def test_an_answer_after_more_than_a_thousand_requests_is_invalid():
    with relayed(PythonNode()) as relay:
        late = {("sample", 5): (Copy(1023),), ("sample", 6): (Copy(1024),)}
        late |= {("sample", 5 + 1023): (), ("sample", 6 + 1024): ()}  # no newer answer arrives with them
        run = RecordedExchange(relay, Script(late), hold_ticks=1, ticks=1100)
    assert [run.column(name)[-1] for name in COUNTS[:5]] == [3, 1, 0, 1, 0]


def test_each_of_thousands_of_lost_requests_counts():
    with relayed(PythonNode()) as relay:
        run = RecordedExchange(relay, Script({("drive", k): () for k in range(5, 3005)}), hold_ticks=1, ticks=3010)
    assert_counts(run, hold_ticks=1)
    assert run.column("node_lost_samples")[-1] == 3000


def test_datagrams_beyond_those_of_a_tick_wait_for_the_next_one():
    with relayed(PythonNode()) as relay:
        relay.floods = {10: 64, 20: 63, 30: 200}
        run = RecordedExchange(relay, Script(), hold_ticks=5, ticks=50)
    assert_counts(run, hold_ticks=5)
    assert run.column("node_held_ticks")[-1] == 1 + 3
    assert run.column("node_invalid_frames")[-1] == 327
    assert run.column("node_lost_samples")[-1] == 0


def test_a_flood_does_not_lengthen_the_wait_for_an_answer():
    """After its deadline a read takes 64 more datagrams, not all that have come; the later reads take the others."""
    with relayed(PythonNode()) as relay, opened(relay, answer="same tick", hold_ticks=5) as (driver, calls):
        relay.floods = {4: 200}  # each tick has two slots: its drive and its request
        relay.begin(Script())
        invalid = []
        for tick in range(8):
            handled = relay.handled
            assert calls.write([0.0]) == 0
            relay.wait_handled(handled + 1)
            driver._opened_card["deadline_ns"] = 0 if 2 <= tick < 6 else 10**10
            invalid.append(calls.read()[1][2 + COUNTS.index("node_invalid_frames")])
            relay.wait_handled(handled + 2)
    assert invalid == [0, 0, 64, 128, 192, 200, 200, 200]


def test_a_node_that_restarts_between_two_datagrams_ends_the_exchange(node, request):
    first = node
    with relayed(first) as relay, opened(relay) as (driver, calls):
        assert [exchange(relay, calls, 4.0)[0] for _ in range(5)] == [0] * 5
        fresh = PythonNode() if isinstance(first, PythonNode) else LibraryNode(request.getfixturevalue("library"), 2)
        start_outputs = fresh.outputs
        relay.node = fresh
        assert exchange(relay, calls, 4.0)[0] == -1
        assert "the node has restarted" in str(driver.error)
        assert [exchange(relay, calls, 4.0)[0] for _ in range(5)] == [-1] * 5
        assert fresh.outputs == start_outputs


def test_a_cable_that_is_out_and_in_again_moves_nothing(node):
    with relayed(node) as relay, opened(relay, hold_ticks=3, watchdog_ms=50.0) as (driver, calls):
        assert exchange(relay, calls, 5.0)[0] == 0
        relay.begin(Script({("drive", i): () for i in range(80)}))
        ages = [exchange(relay, calls, 5.0)[1][1] for _ in range(80)]
        assert [math.isinf(age) for age in ages] == [False] * 3 + [True] * 77  # noticed while the cable is out
        answers = [exchange(relay, calls, 5.0)[0] for _ in range(20)]
        assert answers == [-1] * 20
        assert "the node's watchdog has parked the outputs" in str(driver.error)
        assert relay.applied == []
        assert abs(node.volts(node.outputs[0])) < 1e-5
        assert node.counts[1] == 1


def test_same_tick_requests_are_counted_too(node):
    """A tick requests a sample and waits for it; the tick's second datagram, the drive, requests none."""
    plan, copies, copies_arriving = Plan(9, lost=0.1, late=0, doubled=0.1, damage=0), {}, []
    for tick in range(150):
        copies[("sample", tick)] = fate = plan.fate("sample")
        copies_arriving.append(len(fate))
    with relayed(node) as relay, opened(relay, answer="same tick", deadline_us=1e6, hold_ticks=1) as (driver, calls):
        relay.begin(Script(copies))
        lost = doubled = held = 0
        for tick, count in enumerate(copies_arriving):
            handled = relay.handled
            assert calls.write([0.01 * tick]) == 0
            relay.wait_handled(handled + 1)
            driver._opened_card["deadline_ns"] = 10**10 if count else 0
            status, values = calls.read()
            relay.wait_handled(handled + 2)
            held += not count
            assert status == (not count)
            assert values[7] == held
            assert node.volts(node.outputs[0]) == pytest.approx(0.01 * tick, abs=1e-5)
            lost, doubled = lost + (count == 0), doubled + (count == 2)
        relay.end()
        driver._opened_card["deadline_ns"] = 10**10
        calls.write([0.0])
        values = calls.read()[1]
        assert values[2:5] == [lost, 0, doubled]
        assert relay.output_problems == []
