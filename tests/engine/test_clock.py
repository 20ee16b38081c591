"""Clocks keep an exact grid; missed periods are counted and skipped."""

from __future__ import annotations

import ctypes
import time

import numpy as np
import pytest

from rtloop.engine.clock import Clock, clock_context, paced_clock, unpaced_clock
from rtloop.engine.loop import Outcome
from rtloop.engine.messages import Kind
from rtloop.signals import Flag
from tests.engine.harness import AXIS, IDEAL, LoopBench, ScriptedClock, text

FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.POINTER(ctypes.c_double))
PERIOD_NS = 1_000_000_000_000
RAW = text(IDEAL, AXIS, mode="raw")


def wait(clock: Clock) -> tuple[float, float, float, float]:
    """Wait for the next tick; return its deadline, wake, count of missed periods and monotonic time (times in ns)."""
    timing = (ctypes.c_double * 4)()
    assert FUNCTION(clock.wait)(clock.context, timing) == 0
    return tuple(timing)


@pytest.mark.parametrize("rate_hz", [10_000.0, 3_000.0, 44_100.0, 7.0])
def test_virtual_time_is_the_exact_grid(rate_hz):
    """Deadline k is k/rate in whole ns, without an accumulating error; no time is measured."""
    context = clock_context(rate_hz)
    head, words = np.zeros(1, np.uint64), np.zeros(64, np.uint64)
    clock = unpaced_clock(context, head, words, 3, 10)
    k = np.arange(5000)
    timings = np.array([wait(clock) for _ in k])
    assert np.array_equal(timings[:, 0], np.floor(k * (1e9 / rate_hz)))
    assert np.all(np.isnan(timings[:, [1, 3]]))
    assert not np.any(timings[:, 2])


def test_a_tick_on_time():
    context = clock_context(1e9 / PERIOD_NS)
    clock = paced_clock(context, 50.0)
    context.start_ns = time.monotonic_ns() + 2_000_000
    deadline, wake, missed, monotonic = wait(clock)
    assert (deadline, missed) == (0, 0)
    assert wake >= 0
    assert monotonic - wake == float(context.start_ns[0])
    assert context["index"][0] == 1


def test_missed_periods_are_counted_and_skipped():
    """The test does not wait: it sets the clock's start into the past, with periods of 1000 s."""
    context = clock_context(1e9 / PERIOD_NS)
    clock = paced_clock(context, 0.0)
    elapsed_periods = [0.5, 10.5, 13.25, 14.25, 14.75 + 1e3]  # since the start, at each wait
    deadlines, missed_total = [], 0
    for periods in elapsed_periods:
        context.start_ns = time.monotonic_ns() - round(periods * PERIOD_NS)
        if periods == 14.25:  # tick 14 was due 0.25 periods ago: late, yet no whole period has passed
            assert context["index"][0] == 14
        deadline, wake, missed, _ = wait(clock)
        deadlines.append(deadline / PERIOD_NS)
        missed_total += int(missed)
        assert wake >= deadline
        assert wake - deadline < PERIOD_NS
        assert context["index"][0] == len(deadlines) + missed_total
    assert deadlines == [0, 10, 13, 14, 1014]


@pytest.mark.parametrize("rate_hz", [3_000, 7, 44_100])
def test_a_deadline_long_after_the_start_is_the_exact_one(rate_hz):
    """Deadline k is k/rate in whole ns: a period of whole ns would be 333 µs early at 3 kHz after a million ticks."""
    context = clock_context(rate_hz)
    clock = paced_clock(context, 0.0)
    context.index = 1_000_000
    context.start_ns = time.monotonic_ns() - 1_000_000 * 10**9 // rate_hz
    deadline, _, missed, _ = wait(clock)
    assert deadline == (1_000_000 + int(missed)) * 10**9 // rate_hz


def test_a_late_tick_runs_once():
    """The record of a tick has the periods missed before it; one event begins an episode."""
    us = 1000.0
    script = np.array([[0, 20, 0], [100, 120, 0], [700, 790, 5], [800, 820, 0], [1500, 1510, 6]]) * [us, us, 1]
    bench = LoopBench(RAW, clock=ScriptedClock(np.column_stack([script, np.zeros(5)])))
    rows = bench.run(5)
    assert bench.column(rows, "tick").tolist() == [0, 1, 2, 3, 4]
    assert bench.column(rows, "periods_missed").tolist() == [0, 0, 5, 0, 6]
    np.testing.assert_allclose(bench.column(rows, "lateness_us"), [20, 20, 90, 20, 10])
    assert bench.events() == [(2, Kind.PERIODS_MISSED, 5.0, 0.0)]  # the second late tick belongs to the same episode


def test_an_episode_of_late_ticks_ends_with_its_totals():
    """The first event has 5 missed periods; a second or two later, or at the end of the run, the sum of 623 follows."""
    ticks = 38_000
    missed = np.zeros(ticks)
    missed[[100, 105, 400]] = 5, 7, 611
    missed[22_000] = 4  # a single late tick: its first event has the total
    missed[33_000], missed[37_990] = 2, 3
    script = np.zeros((ticks, 4))
    script[:, 0] = 1e5 * (np.arange(ticks) + np.cumsum(missed))
    script[:, 1], script[:, 2] = script[:, 0] + 1e3, missed
    bench = LoopBench(RAW, clock=ScriptedClock(script))
    bench.run(ticks + 1)  # the clock fails at the end of its script
    assert bench.outcome is Outcome.DRIVER_FAILED
    assert bench.events(3) == [
        (100, Kind.PERIODS_MISSED, 5.0, 0.0, 0.0),
        (20_000, Kind.LATENESS_OVER, 623.0, 3.0, 611.0),
        (22_000, Kind.PERIODS_MISSED, 4.0, 0.0, 0.0),
        (33_000, Kind.PERIODS_MISSED, 2.0, 0.0, 0.0),
        (38_000, Kind.LATENESS_OVER, 5.0, 2.0, 3.0),
    ]


def test_measured_times_and_overruns():
    """Read, law, write and record take longer in this order; a late and long tick overruns."""
    us = 1000.0
    script = np.array([[0, 20], [100, 159], [200, 261]]) * us
    bench = LoopBench(RAW, clock=ScriptedClock(np.column_stack([script, np.zeros((3, 2))])))
    rows = bench.run(3)
    for name, expected_us in (("read_us", 4), ("law_us", 8), ("write_us", 12), ("exec_us", 40)):
        np.testing.assert_allclose(bench.column(rows, name), expected_us)
    assert bench.column(rows, "flags").tolist() == [0, 0, Flag.OVERRUN]


def test_virtual_time_waits_for_the_recorder():
    """No slot of the ring is overwritten before it is read: the writer waits for the reader."""
    bench = LoopBench(RAW)
    rows = bench.run(150_000)  # more than two rings; `run` drains the ring in between and loses no slot
    assert np.array_equal(bench.column(rows, "tick"), np.arange(150_000))
    assert np.array_equal(bench.column(rows, "deadline_ns"), np.arange(150_000) * 100_000.0)
    assert np.all(np.isnan(rows[:, 2:7]))
