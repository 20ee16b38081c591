"""Rules 8 and 10 of docs/node-protocol.md for the library of deploy/node: the watchdog, and ramps."""

from __future__ import annotations

import itertools

import pytest

from tests.node.bench import FAR, LONGEST_HOLD_US, OTHER, OUTPUTS, SAFE, Bench
from tests.node.frames import (
    ANSWER,
    APPLY,
    OPEN,
    PARK,
    READY,
    UNKNOWN,
    WATCHDOG,
    flags,
    reason,
)

# Rule 8


@pytest.mark.parametrize("hold_us", [1, 999, 2500, LONGEST_HOLD_US])
def test_the_watchdog_ends_the_session_at_its_microsecond(bench: Bench, hold_us: int):
    bench.open_and_set([400, 100], digital=1, hold_us=hold_us)
    assert bench.due_us == bench.now_us + hold_us
    bench.poll(hold_us - 1)
    assert (bench.counters.watchdog_trips, bench.digital) == (0, 1)
    bench.poll(1)
    assert (bench.counters.watchdog_trips, bench.digital, bench.codes) == (1, 0, [400, 100])
    bench.poll(999)
    assert bench.codes == [400, 100]
    bench.poll(1)
    assert bench.codes == [370, 93]


def test_the_watchdog_counts_from_the_newest_drive(bench: Bench):
    bench.open(hold_us=3000)
    for act in (APPLY, 0, ANSWER):
        bench.now_us += 2999
        bench.drive(act, hold_us=3000)
    bench.poll(2999)
    assert bench.counters.watchdog_trips == 0
    bench.poll(1)
    assert bench.counters.watchdog_trips == 1


def test_a_frame_after_the_hold_comes_too_late_even_if_nobody_polled(bench: Bench):
    bench.open_and_set([1000, 0], hold_us=2000)
    bench.now_us += 2000
    assert reason(bench.drive(APPLY | ANSWER, FAR)) == WATCHDOG
    assert bench.counters.watchdog_trips == 1
    assert bench.codes == [1000, 0]


def test_a_cable_that_is_plugged_in_again_moves_nothing(bench: Bench):
    bench.open_and_set([1000, 0], hold_us=2000)
    bench.run(100_000)
    assert bench.codes == SAFE
    writes = bench.counters.writes
    for act in (APPLY, 0, PARK):
        assert reason(bench.drive(act | ANSWER, FAR)) == WATCHDOG
        assert reason(bench.drive(act | ANSWER, FAR, session=6)) == UNKNOWN
        assert reason(bench.drive(act | ANSWER, FAR, sender=OTHER)) == WATCHDOG
    assert bench.counters.writes == writes
    bench.open_and_set(FAR, session=6, sender=OTHER)


def test_a_session_that_the_watchdog_ended_is_remembered_after_another_was_parked(bench: Bench):
    bench.open(hold_us=1000)
    bench.poll(1000)
    bench.open(session=6)
    bench.drive(PARK, session=6)
    assert reason(bench.drive(APPLY, session=5)) == WATCHDOG
    assert reason(bench.drive(APPLY, session=6)) == UNKNOWN


def test_a_clock_that_steps_back_neither_trips_nor_moves(bench: Bench):
    bench.open_and_set(FAR)
    bench.now_us -= 500_000
    bench.poll()
    assert reason(bench.drive(APPLY | ANSWER, FAR)) == 0
    assert bench.counters.watchdog_trips == 0


# Rule 10


def test_a_ramp_takes_the_steps_that_are_due_and_no_more(bench: Bench):
    bench.open_and_set(FAR, hold_us=5000)
    first = bench.counters.writes
    for step_us in itertools.islice(itertools.cycle([1, 137, 500, 999, 1000, 1700, 3001]), 9000):
        bench.poll(step_us)
    writes = bench.writes(first - 1)
    assert writes[-1].codes == SAFE
    moves = [(a, b) for a, b in itertools.pairwise(writes) if a.codes != b.codes]
    assert len(moves) == 2886
    for i, channel in enumerate(OUTPUTS):
        changes = [b.codes[i] - a.codes[i] for a, b in moves]
        assert max(map(abs, changes)) == channel.change_per_ms
        assert all(change <= 0 for change in changes)
    times = [move[1].time_us for move in moves]
    assert min(b - a for a, b in itertools.pairwise(times)) >= 1000
    assert {write.digital for write in writes} == {0}


def test_a_ramp_that_is_called_on_time_lasts_one_millisecond_a_step(bench: Bench):
    bench.open_and_set([100 - 30 * 40, -200])
    start_us = bench.now_us
    bench.drive(PARK)
    while (due_us := bench.due_us) != 2**64 - 1:
        bench.now_us = due_us
        bench.poll()
    assert bench.now_us - start_us == 40_000
    assert bench.codes == SAFE


def test_a_ramp_from_end_to_end_of_the_numbers_does_not_wrap(bench: Bench):
    lowest, highest = -(2**31), 2**31 - 1
    channel = OUTPUTS[0]._replace(lowest=lowest, highest=highest, safe=lowest, change_per_ms=2**32 - 1)
    slow = channel._replace(safe=highest, change_per_ms=2**30)
    bench.start(outputs=[channel, slow])
    bench.drive(OPEN, [0, 0])
    bench.drive(APPLY, [highest, lowest])
    bench.drive(PARK, [0, 0])
    bench.run(5000)
    codes = [write.codes for write in bench.writes(bench.counters.writes - 5)]
    assert codes == [[highest, lowest], *([lowest, code] for code in (-(2**30), 0, 2**30, highest))]


def test_a_new_session_during_a_ramp_waits_for_its_end(bench: Bench):
    bench.open_and_set([100 + 90, -200])
    bench.drive(PARK)
    bench.poll(1000)
    assert flags(bench.drive(OPEN | ANSWER, session=6, sender=OTHER)) == 0
    bench.poll(1000)
    bench.poll(1000)
    assert flags(bench.drive(APPLY | ANSWER, [7, 7], session=6, sender=OTHER)) == READY
    assert bench.codes == [7, 7]


def test_the_watchdog_does_not_interrupt_an_opening_ramp(bench: Bench):
    bench.open_and_set([100 + 300, -200])
    bench.drive(OPEN, hold_us=2500)
    bench.run(12_000, 500)
    times = [w.time_us for a, w in itertools.pairwise(bench.writes(2)) if a.codes != w.codes]
    assert [b - a for a, b in itertools.pairwise(times)] == [1000] * 9
    assert bench.counters.watchdog_trips == 1
    assert reason(bench.drive(APPLY, FAR)) == WATCHDOG
