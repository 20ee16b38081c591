"""Rules 1 to 5 and 9 of docs/node-protocol.md for the library of deploy/node: sessions of the loops."""

from __future__ import annotations

import pytest

from tests.node.bench import FAR, LOOP, OTHER, SAFE, Bench, open_node
from tests.node.frames import (
    ANSWER,
    APPLY,
    AT_SAFE,
    BUSY,
    OPEN,
    PARK,
    READY,
    UNKNOWN,
    WATCHDOG,
    Refusal,
    flags,
    reason,
)

# Rule 1


def test_a_node_starts_at_its_safe_codes_without_a_session(bench: Bench):
    assert [(write.codes, write.digital) for write in bench.writes()] == [(SAFE, 0)]
    assert reason(bench.drive(APPLY | ANSWER, [0, 0])) == UNKNOWN
    assert bench.counters.writes == 1
    assert bench.due_us == 2**64 - 1


# Rule 2


def test_a_second_loop_is_refused_and_the_first_goes_on(bench: Bench):
    bench.open_and_set([0, 0])
    own = bench.seal
    for session, sender in ((6, OTHER), (6, LOOP)):
        for act in (OPEN, APPLY, PARK, 0):
            assert reason(bench.drive(act | ANSWER, [50, 50], session, sender)) == BUSY
    bench.seal = own
    assert bench.codes == [0, 0]
    assert bench.counters.sessions == 1
    assert flags(bench.drive(APPLY | ANSWER, [1, 1])) == READY
    assert bench.codes == [1, 1]


@open_node
def test_the_sessions_number_from_another_address_is_refused(bench: Bench):
    bench.open_and_set([0, 0])
    for act in (OPEN, APPLY, PARK, 0):
        assert reason(bench.drive(act | ANSWER, [50, 50], sender=OTHER)) == BUSY
    assert bench.codes == [0, 0]


# Rule 3


def test_a_session_opens_with_any_sequence_and_its_loop_goes_on_from_there(bench: Bench):
    bench.open(sequence=4_000_000_000)
    assert flags(bench.drive(APPLY | ANSWER, [1, 2], sequence=4_000_000_001)) == READY
    assert bench.counters.sessions == 1


def test_a_repeated_open_is_answered_and_does_not_interrupt_the_ramp(bench: Bench):
    bench.open_and_set(FAR)
    first = bench.counters.writes
    bench.drive(OPEN | ANSWER)
    for _ in range(20):
        bench.poll(500)
        assert bench.drive(OPEN | ANSWER, sequence=bench.sequence) is None  # a copy
        bench.poll(500)
        assert flags(bench.drive(OPEN | ANSWER)) == 0
    assert bench.codes == [3000 - 20 * 30, 20000 - 20 * 7]
    assert len({tuple(write.codes) for write in bench.writes(first)}) == 21
    assert bench.counters.sessions == 1


def test_an_open_that_the_network_delayed_does_not_begin_the_session_anew(bench: Bench):
    bench.open_and_set(FAR, digital=3)
    assert bench.drive(OPEN | ANSWER, sequence=1) is None
    assert bench.counters.old == 1
    assert (bench.codes, bench.digital) == (FAR, 3)


def test_an_open_of_session_0_is_refused(bench: Bench):
    assert reason(bench.drive(OPEN | ANSWER, session=0)) == UNKNOWN
    assert reason(bench.drive(APPLY | ANSWER, session=0)) == UNKNOWN
    assert reason(bench.drive(PARK | ANSWER, session=0)) == UNKNOWN
    assert bench.counters.sessions == 0


# Rule 4


@pytest.mark.parametrize(
    ("distance", "accepted"),
    [
        (1, True),
        (2, True),
        (40_000, True),
        (40_001, False),
        (2**30, False),
        (2**31, False),
        (2**32 - 1, False),
        (0, False),
    ],
)
@pytest.mark.parametrize("newest", [7, 2**31 - 1, 2**32 - 1])
def test_a_drive_must_be_newer_than_the_newest(bench: Bench, newest: int, distance: int, accepted: bool):
    bench.open(sequence=newest)
    bench.seal = bench.seal._replace(turn=int(accepted and newest + distance >= 2**32))
    answer = bench.drive(APPLY | ANSWER, [9, 9], sequence=(newest + distance) % 2**32)
    assert (answer is not None) is accepted
    assert bench.codes == ([9, 9] if accepted else SAFE)
    assert bench.counters.old == (not accepted)
    assert (bench.drive(OPEN | ANSWER, sequence=newest + 80_001) is None, bench.counters.old) == (True, 2 - accepted)


@pytest.mark.parametrize(
    ("period_us", "furthest"), [(0, 2_000_000), (1, 2_000_000), (3, 666_666), (1_500_000, 2), (2**32 - 1, 2)]
)
def test_a_drive_may_be_as_far_ahead_as_a_second_holds(bench: Bench, period_us: int, furthest: int):
    bench.start(period_us=period_us)
    bench.open(sequence=7)
    assert bench.drive(ANSWER, sequence=7 + furthest + 1) is None
    assert flags(bench.drive(ANSWER, sequence=7 + furthest)) & READY
    assert bench.counters.old == 1


@pytest.mark.parametrize("distance", [0, -1, 2, 40_001, 2**30, 2**31 - 1, 2**31, 2**31 + 1])
def test_a_park_is_obeyed_whatever_its_sequence(bench: Bench, distance: int):
    bench.open_and_set([100 + 90, -200], digital=1)
    assert flags(bench.drive(PARK | ANSWER, sequence=(bench.sequence + distance) % 2**32)) == 0
    assert bench.digital == 0
    bench.run(3000)
    assert bench.codes == SAFE
    assert flags(bench.drive(PARK | ANSWER, sequence=(bench.sequence + distance) % 2**32)) == AT_SAFE
    assert bench.counters.old == bench.counters.watchdog_trips == 0


def test_an_old_drive_does_not_feed_the_watchdog(bench: Bench):
    bench.open(hold_us=2000)
    bench.now_us += 1999
    assert bench.drive(ANSWER, sequence=bench.sequence, hold_us=2000) is None
    bench.poll(1)
    assert bench.counters.watchdog_trips == 1


# Rule 5, see the rules 2, 8 and 9 as well


def test_a_restarted_node_knows_no_session_and_says_its_new_boot(bench: Bench):
    bench.open_and_set(FAR)
    assert bench.start(boot=77)
    assert bench.codes == SAFE
    answer = bench.drive(APPLY | ANSWER, FAR)
    assert answer == Refusal(bench.sequence, 5, 77, UNKNOWN, tag=bench.tag)
    assert bench.codes == SAFE


# Rule 9


def test_park_ends_the_session_and_is_answered_until_safe(bench: Bench):
    bench.open_and_set([100 + 75, -190], digital=6)
    assert flags(bench.drive(PARK | ANSWER, FAR, digital=6)) == 0
    assert (bench.codes, bench.digital) == ([175, -190], 0)
    reports = []
    for _ in range(4):
        bench.poll(1000)
        reports.append((bench.codes, flags(bench.drive(PARK | ANSWER))))
    assert reports == [([145, -197], 0), ([115, -200], 0), (SAFE, AT_SAFE), (SAFE, AT_SAFE)]
    assert reason(bench.drive(APPLY | ANSWER)) == UNKNOWN
    if not bench.seal.key:
        assert reason(bench.drive(PARK | ANSWER, sender=OTHER)) == UNKNOWN
    assert bench.drive(PARK) is None
    assert bench.counters.watchdog_trips == 0


def test_a_parked_session_does_not_feed_the_watchdog_of_the_next(bench: Bench):
    bench.open()
    own, has_key = bench.seal, bench.seal.key is not None
    bench.drive(PARK)
    bench.open(session=6, sender=OTHER)
    bench.seal = own
    answer = bench.drive(PARK | ANSWER)
    assert answer is None if has_key else reason(answer) == BUSY
    bench.poll(10_000)
    assert bench.counters.watchdog_trips == 1
    answer = bench.drive(PARK | ANSWER)
    assert answer is None if has_key else flags(answer) == AT_SAFE


def test_a_session_that_was_opened_again_has_ended_in_its_latest_way(bench: Bench):
    bench.open()
    bench.drive(PARK)
    bench.open(hold_us=1000)
    bench.poll(1000)
    assert reason(bench.drive(PARK | ANSWER)) == WATCHDOG
    bench.open()
    bench.drive(PARK)
    assert reason(bench.drive(APPLY | ANSWER)) == UNKNOWN


def test_the_nodes_own_park_ends_the_session(bench: Bench):
    bench.open_and_set([150, -200], digital=1)
    bench.park()
    assert (bench.codes, bench.digital) == ([150, -200], 0)
    assert reason(bench.drive(APPLY | ANSWER, FAR)) == UNKNOWN
    bench.run(2000)
    assert bench.codes == SAFE
