"""Rules 6 and 7 of docs/node-protocol.md for the library of deploy/node: the codes that reach the outputs."""

from __future__ import annotations

import pytest

from tests.node.bench import BOOT, FAR, LONGEST_HOLD_US, Bench
from tests.node.frames import (
    ANSWER,
    APPLY,
    FLAGS,
    OPEN,
    PARK,
    RANGE,
    READY,
    SIZE,
    Refusal,
    flags,
    reason,
)

# Rule 6


@pytest.mark.parametrize(
    ("act", "codes", "hold_us", "expected"),
    [
        (APPLY, [0], 1000, SIZE),
        (APPLY, [0, 0, 0], 1000, SIZE),
        (APPLY, [], 1000, SIZE),
        (APPLY, [0] * 255, 1000, SIZE),
        (APPLY, [0, 40001], 1000, RANGE),
        (APPLY, [0, -501], 1000, RANGE),
        (APPLY, [32768, 0], 1000, RANGE),
        (APPLY, [-(2**31), 0], 1000, RANGE),
        (APPLY, [0, 0], 0, FLAGS),
        (0, [0, 0], 0, FLAGS),
        (APPLY | PARK, [0, 0], 1000, FLAGS),
        (APPLY | OPEN, [0, 0], 1000, FLAGS),
        (OPEN | PARK, [0, 0], 1000, FLAGS),
        (OPEN | PARK | APPLY, [0, 0], 1000, FLAGS),
    ],
)
def test_a_drive_is_judged_as_a_whole_before_any_output_moves(
    bench: Bench, act: int, codes: list[int], hold_us: int, expected: int
):
    bench.open_and_set([1, 1], digital=2)
    before = bench.counters
    bench.now_us += 5000
    answer = bench.drive(act | ANSWER, codes, digital=1, hold_us=hold_us)
    assert answer == Refusal(bench.sequence, 5, BOOT, expected, 2, 1, bench.tag)
    assert bench.counters == before._replace(refused=before.refused + 1)
    bench.poll(4999)
    assert bench.counters.watchdog_trips == 0
    bench.poll(1)  # a refused frame does not feed the watchdog
    assert bench.counters.watchdog_trips == 1


def test_the_ends_of_a_range_are_allowed(bench: Bench):
    bench.open()
    for codes in ([-32768, -500], [32767, 40000]):
        bench.drive(APPLY, codes)
        assert bench.codes == codes


def test_a_refused_open_opens_no_session(bench: Bench):
    assert reason(bench.drive(OPEN, [0])) == SIZE
    assert reason(bench.drive(OPEN, [0, 50000])) == RANGE
    assert reason(bench.drive(OPEN, hold_us=0)) == FLAGS
    assert bench.counters.sessions == 0


@pytest.mark.parametrize("hold_us", [LONGEST_HOLD_US, LONGEST_HOLD_US + 1, 2**32 - 1])
def test_a_hold_is_shortened_to_the_nodes_longest(bench: Bench, hold_us: int):
    bench.open(hold_us=hold_us)
    bench.poll(LONGEST_HOLD_US - 1)
    assert bench.counters.watchdog_trips == 0
    bench.poll(1)
    assert bench.counters.watchdog_trips == 1


# Rule 7


def test_apply_before_ready_moves_no_output_and_feeds_the_watchdog(bench: Bench):
    bench.open_and_set([100 + 90, -200], digital=5)
    bench.drive(OPEN)
    assert bench.digital == 0
    for _ in range(2):
        bench.poll(1000)
        answer = bench.sample(APPLY | ANSWER, FAR, digital=7, hold_us=1001)
        assert (flags(answer), answer.applied, bench.digital) == (0, 0, 0)
    assert bench.codes == [100 + 30, -200]
    bench.poll(1000)
    answer = bench.sample(APPLY | ANSWER, FAR, digital=7, hold_us=1001)
    assert (flags(answer), answer.applied) == (READY, bench.sequence)
    assert (bench.codes, bench.digital) == (FAR, 7)
