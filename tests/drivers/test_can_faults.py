"""Frames lost, doubled, reordered and delayed at random are counted exactly, and held or tripped as configured.

The oracle, `expected_counts`, counts from the frames that the bus handed over.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import accumulate, count

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtloop.drivers.base import Wiring
from rtloop.drivers.can.bus import open_bus
from rtloop.drivers.can.driver import OBSERVED, CanDriver
from rtloop.drivers.can.node import RigNode
from rtloop.drivers.can.options import CanOptions
from rtloop.drivers.can.stream import AnswerStream
from rtloop.signals import Flag
from tests.drivers.faulty_bus import FaultyBus
from tests.engine.harness import AXIS, LoopBench, text

TICKS = 60
CHANNELS = count()
RAW = text(
    AXIS, "[axis.interlocks]\nsample_age_us = 1e9\n", '[axis.reference]\nkind = "hold"\nvalue = 1.0\n', mode="raw"
)
GOOD = (0,)
DELIVERY = st.lists(st.integers(0, 4), max_size=3).map(tuple)
SCRIPTS = st.lists(st.one_of(st.just(GOOD), st.just(GOOD), DELIVERY), min_size=TICKS, max_size=TICKS)
PLAN = LoopBench(RAW).plan


class FaultyLoop:
    """A run of a loop and its node, with the faulty bus between them, in virtual time."""

    def __init__(self, deliveries: list[tuple[int, ...]], hold_ticks: int) -> None:
        options = CanOptions(interface="virtual", channel=f"faulty-{next(CHANNELS)}", hold_ticks=hold_ticks)
        self.node_bus = open_bus(options)
        node = RigNode(self.node_bus, options, ["x"])
        FaultyBus.node = staticmethod(node.step)
        self.driver = CanDriver(
            options.model_copy(update={"interface": "faulty"}), {"x": Wiring("adc0", "dac0")}, 1000.0
        )
        bench = LoopBench(replace(PLAN, observed=OBSERVED), self.driver)
        bus = self.driver._bus
        assert isinstance(bus, FaultyBus)
        bench.run(1)  # the first tick requests its own sample
        bus.deliveries = deliveries
        self.rows = bench.run(TICKS)
        self.columns = bench.plan.columns
        self.arrivals = bus.arrivals[:TICKS]
        bus.deliveries = None
        self.driver.close()
        self.node_bus.shutdown()

    def column(self, name: str) -> np.ndarray:
        """Return one column of the rows (ticks)."""
        return self.rows[:, self.columns.index(name)]


def expected_counts(arrivals: list[list[int]]) -> list[dict[str, int]]:
    """Return the counts of faults after each tick, by their definitions; in tick k, answer k + 1 is due."""
    received: list[int] = []
    held, counts = 0, []
    for tick, numbers in enumerate(arrivals):
        received += numbers
        firsts = [number for i, number in enumerate(received) if number not in received[:i]]
        late = sum(any(earlier > number for earlier in firsts[:i]) for i, number in enumerate(firsts))
        newest = max(firsts, default=0)
        held += newest != tick + 1
        counts.append({"can_lost_samples": newest - len(firsts), "can_reordered_samples": late,
                      "can_duplicated_samples": len(received) - len(firsts), "can_held_ticks": held})  # fmt: skip
    return counts


@settings(max_examples=25, deadline=None)
@given(SCRIPTS, st.integers(0, 6))
def test_faults_are_counted_exactly_and_held_or_tripped(deliveries, hold_ticks):
    loop = FaultyLoop(deliveries, hold_ticks)
    expected = expected_counts(loop.arrivals)
    for name in expected[0]:
        assert loop.column(name).tolist() == [row[name] for row in expected], name
    assert not np.any(loop.column("can_invalid_frames"))
    held = np.diff([0, *(row["can_held_ticks"] for row in expected)])
    assert loop.column("driver_status").tolist() == held.tolist()
    runs = list(accumulate(held, lambda run, is_held: (run + 1) * bool(is_held), initial=0))
    beyond = np.array(runs[1:]) > hold_ticks
    np.testing.assert_array_equal(np.isinf(loop.column("sample_age_us")), beyond)
    stale = (loop.column("flags").astype(int) & Flag.TRIP_STALE) != 0
    first = int(np.argmax(beyond)) if np.any(beyond) else TICKS
    np.testing.assert_array_equal(stale, np.arange(TICKS) >= first)


def test_a_good_bus_has_no_faults():
    loop = FaultyLoop([GOOD] * TICKS, 0)
    assert not np.any(loop.rows[:, [loop.columns.index(name) for name in (*OBSERVED, "driver_status", "flags")]])


def test_the_sample_is_that_of_the_drive_before():
    """The delay is one tick longer than with an ADC read in the tick: sample k + 2 is the first to show u(k)."""
    loop = FaultyLoop([GOOD] * TICKS, 0)
    assert loop.column("tick").tolist() == list(range(1, TICKS + 1))
    assert loop.arrivals == [[k + 1] for k in range(TICKS)]


@pytest.mark.parametrize("highest", [1500, 65535])
def test_numbers_wrap_round(highest):
    """Count three rounds of sequence numbers with lost (every 7th), doubled (11th) and swapped (13th) answers."""
    stream, waiting = AnswerStream(highest), None
    lost = doubled = swapped = 0
    for number in range(1, 3 * highest + 1):
        sequence = stream.next_sequence()
        assert 1 <= sequence <= highest
        if waiting is not None:
            assert stream.count_answer(sequence)
            assert not stream.count_answer(waiting)
            waiting = None
        elif number % 7 == 0:
            lost += 1
        elif number % 13 == 0:
            waiting, swapped = sequence, swapped + 1
        else:
            assert stream.count_answer(sequence)
            if number % 11 == 0:
                assert not stream.count_answer(sequence)
                doubled += 1
    assert (stream.duplicated, stream.reordered, stream.invalid) == (doubled, swapped, 0)
    assert stream.lost in (lost, lost - 1)


def test_an_answer_without_request_is_invalid():
    stream = AnswerStream(65535)
    for _ in range(2000):
        stream.count_answer(stream.next_sequence())
    for sequence in (2001, 3000, 999, 60000):
        assert not stream.count_answer(sequence)
    assert (stream.invalid, stream.lost, stream.duplicated) == (4, 0, 0)
    assert math.isclose(stream.newest, 2000)
