"""The tags of docs/node-protocol.md: who may drive a node that has a key."""

from __future__ import annotations

import ctypes
import random
import struct
import zlib
from collections.abc import Callable

import pytest

from tests.node.bench import BOOT, FAR, KEY, LOOP, OTHER, SAFE, Bench, keyed_node, open_node
from tests.node.frames import (
    ANSWER,
    APPLY,
    AT_SAFE,
    BUSY,
    DRIVE,
    OPEN,
    PARK,
    READY,
    UNKNOWN,
    WATCHDOG,
    Refusal,
    Sample,
    Seal,
    Welcome,
    drive,
    flags,
    frame,
    hello,
    parse,
    reason,
    siphash,
)

OTHER_KEY = bytes(16)


def with_check(content: bytes) -> bytes:
    """Return bytes with their CRC in place of the last four."""
    return content[:-4] + struct.pack("<I", zlib.crc32(content[:-4]))


# SipHash


def test_the_oracle_has_the_vector_of_the_paper():
    assert siphash(bytes(range(16)), bytes(range(15))) == 0xA129CA6149BE45E5  # appendix A of the paper


def test_the_library_computes_siphash(library: ctypes.CDLL):
    numbers = random.Random(1)
    cases = [(bytes(range(16)), bytes(range(length))) for length in range(64)]  # the vectors of the reference
    cases += [(numbers.randbytes(16), numbers.randbytes(length)) for length in (100, 255, 256, 257, 511, 1448)]
    for key, message in cases:
        assert library.bench_siphash(key, message, ctypes.c_size_t(len(message))) == siphash(key, message)
        shifted = ctypes.create_string_buffer(b"\xff" + message, len(message) + 1)
        unaligned = ctypes.c_void_p(ctypes.addressof(shifted) + 1)
        assert library.bench_siphash(key, unaligned, ctypes.c_size_t(len(message))) == siphash(key, message)


# Tags


@open_node
def test_without_a_key_every_tag_is_0_and_nobody_looks_at_it(bench: Bench):
    bench.seal = Seal(KEY)
    answers = [bench.send_bytes(content) for content in (hello(), drive(5, 1, APPLY | ANSWER, SAFE, seal=bench.seal))]
    assert [answer[-12:-4] for answer in answers] == [bytes(8)] * 2
    refusal = parse(answers[1])
    assert isinstance(refusal, Refusal)
    assert (refusal.reason, refusal.opening) == (UNKNOWN, 0)
    assert answers[1][24:32] == drive(5, 1, APPLY | ANSWER, SAFE, seal=bench.seal)[-12:-4]
    answer = bench.send_bytes(drive(5, 2, OPEN | ANSWER, SAFE, seal=bench.seal))
    assert answer[-12:-4] == bytes(8)
    assert isinstance(parse(answer), Sample)
    assert bench.counters.foreign == 0


OWN = Seal(KEY, BOOT, 0, 0)


@keyed_node
@pytest.mark.parametrize("act", [OPEN, APPLY, 0, PARK])
@pytest.mark.parametrize(
    "seal",
    [
        Seal(),
        OWN._replace(key=OTHER_KEY),
        OWN._replace(boot=BOOT + 1),
        OWN._replace(opening=1),
        OWN._replace(opening=2**32 - 1),
        OWN._replace(turn=1),
        OWN._replace(turn=2**32 - 1),
    ],
)
def test_a_drive_with_another_tag_moves_nothing_and_is_not_answered(bench: Bench, act: int, seal: Seal):
    bench.open_and_set([5, 5], hold_us=3000)
    before = bench.counters
    bench.now_us += 2999
    assert bench.send_bytes(drive(5, bench.sequence + 1, act | ANSWER, FAR, hold_us=3000, seal=seal)) == b""
    assert bench.counters == before._replace(foreign=1)
    assert bench.sample(ANSWER, hold_us=3000).flags == READY  # the same sequence is still free
    bench.now_us += 2999
    assert bench.send_bytes(drive(5, bench.sequence + 1, act | ANSWER, FAR, hold_us=3000, seal=seal)) == b""
    bench.poll(1)  # a foreign frame does not feed the watchdog
    assert bench.counters.watchdog_trips == 1


@keyed_node
def test_each_bit_of_a_drive_is_in_its_tag(bench: Bench):
    bench.open_and_set([5, 5])
    before = bench.counters
    good = drive(5, bench.sequence + 1, APPLY | ANSWER, [6, 6], seal=bench.seal)
    for place in range(8 * (len(good) - 4)):
        changed = bytearray(good)
        changed[place // 8] ^= 1 << place % 8
        assert bench.send_bytes(with_check(bytes(changed))) == b""
    assert bench.counters == before._replace(foreign=bench.counters.foreign, invalid=bench.counters.invalid)
    assert bench.counters.foreign + bench.counters.invalid == 8 * (len(good) - 4)
    assert bench.counters.invalid == 8 * 4 + 8  # magic, format, batches, and the number of codes
    assert isinstance(bench.send(good), Sample)
    assert bench.codes == [6, 6]


@keyed_node
def test_a_tag_that_is_cut_or_missing_makes_no_frame(bench: Bench):
    bench.open_and_set([5, 5])
    good = drive(5, bench.sequence + 1, APPLY | ANSWER, FAR, seal=bench.seal)
    before = bench.counters
    contents = [with_check(good[: len(good) - cut]) for cut in range(1, 13)]
    contents.append(frame(DRIVE, bench.sequence + 1, good[8:-12]))
    assert [bench.send_bytes(content) for content in contents] == [b""] * 13
    assert bench.counters == before._replace(invalid=before.invalid + 13)


@keyed_node
def test_a_refusal_has_the_tag_of_the_drive_and_its_own(bench: Bench):
    answer = bench.drive(APPLY | ANSWER)
    assert answer == Refusal(1, 5, BOOT, UNKNOWN, 2, 0, bench.tag)
    bench.open()
    answer = bench.drive(OPEN | ANSWER, session=6, sender=OTHER)
    assert answer == Refusal(3, 6, BOOT, BUSY, 2, 1, bench.tag)


@keyed_node
def test_a_node_without_a_session_tells_everybody_that_it_has_none(bench: Bench):
    bench.open_and_set(SAFE, hold_us=1000)
    bench.poll(1000)
    for session, expected in ((5, WATCHDOG), (6, UNKNOWN)):
        for act in (0, APPLY, PARK):
            assert reason(bench.send(drive(session, 9, act | ANSWER, FAR))) == expected  # without a tag
    assert bench.send(drive(6, 9, OPEN | ANSWER, FAR)) is None
    assert (bench.counters.foreign, bench.counters.sessions) == (1, 1)


# Addresses


@keyed_node
@pytest.mark.parametrize("act", [OPEN, APPLY, 0])
def test_a_copy_from_another_address_gets_no_answer_that_the_loop_must_believe(bench: Bench, act: int):
    bench.open_and_set([5, 5])
    before = bench.counters
    copy = drive(5, bench.sequence + 1, act | ANSWER, [6, 6], seal=bench.seal)
    assert bench.send_bytes(copy, OTHER) == b""
    assert bench.counters == before._replace(foreign=before.foreign + 1)
    assert isinstance(bench.send(copy), Sample)


@keyed_node
def test_a_park_with_the_key_needs_no_address(bench: Bench):
    bench.open_and_set([100 + 30, -200])
    assert flags(bench.drive(PARK | ANSWER, sender=OTHER)) == 0
    bench.poll(1000)
    assert flags(bench.drive(PARK | ANSWER)) == flags(bench.drive(PARK | ANSWER, sender=OTHER)) == AT_SAFE
    assert bench.counters.watchdog_trips == 0


# Recorded frames


def record_a_session(bench: Bench) -> list[bytes]:
    """Return the frames of a session that opens, moves the outputs far, and parks."""
    welcome = bench.send(hello())
    assert isinstance(welcome, Welcome)
    seal = bench.seal._replace(opening=welcome.opening)
    acts = [(OPEN, SAFE), (APPLY, FAR), (APPLY, SAFE), (0, SAFE), (PARK, SAFE)]
    frames = [drive(5, 100 + i, act | ANSWER, codes, seal=seal) for i, (act, codes) in enumerate(acts)]
    assert all(isinstance(bench.send(content), Sample) for content in frames[:2])
    assert bench.codes == FAR
    assert all(isinstance(bench.send(content), Sample) for content in frames[2:])
    return frames


@keyed_node
@pytest.mark.parametrize(
    ("prepare", "is_open"),
    [
        (lambda bench: None, False),
        (lambda bench: bench.start(boot=BOOT + 1), False),
        (lambda bench: bench.open(session=6), True),
        (lambda bench: bench.open(sequence=50), True),  # with the recorded number, before its sequences
    ],
)
def test_a_recorded_session_moves_nothing_a_second_time(
    bench: Bench, prepare: Callable[[Bench], object], is_open: bool
):
    frames = record_a_session(bench)
    prepare(bench)
    bench.now_us += 9999
    before = bench.counters
    for content in frames:
        for sender in (LOOP, OTHER):
            bench.send(content, sender)
    bench.poll(1)
    after = bench.counters
    assert (after.sessions, after.old) == (before.sessions, before.old)
    assert after.watchdog_trips == bool(is_open)  # a recorded frame does not feed the watchdog
    assert after.writes - before.writes == after.watchdog_trips
    assert after.foreign - before.foreign >= 2
    assert bench.codes == SAFE


@keyed_node
def test_an_open_for_a_later_opening_is_of_no_use_before_or_after_it(bench: Bench):
    ahead = [drive(9, 1, OPEN | ANSWER, SAFE, seal=OWN._replace(opening=opening)) for opening in (0, 1, 2)]
    bench.open()
    assert [bench.send_bytes(content) for content in (ahead[0], ahead[2])] == [b""] * 2
    assert reason(bench.send(ahead[1])) == BUSY
    bench.drive(PARK)
    bench.open(session=6)
    bench.drive(PARK, session=6)
    assert [bench.send_bytes(content) for content in ahead[:2]] == [b""] * 2
    assert bench.counters.sessions == 2


# Sequences


def test_a_jump_of_the_sequence_moves_nothing_and_the_loop_goes_on(bench: Bench):
    """The attack on version 1 of the protocol: a frame from the loop's own address, far ahead."""
    bench.open_and_set([5, 5])
    for act in (APPLY, 0, OPEN):
        for codes in (FAR, SAFE):
            assert bench.send(drive(5, bench.sequence + 2**30, act | ANSWER, codes, seal=bench.seal)) is None
    assert bench.codes == [5, 5]
    assert flags(bench.drive(APPLY | ANSWER, [6, 6])) == READY
    assert bench.codes == [6, 6]
    assert flags(bench.drive(PARK | ANSWER)) == 0


def test_a_frame_fits_no_second_time_when_its_sequence_comes_again(bench: Bench):
    bench.start(period_us=1)
    bench.open(sequence=2**32 - 5, hold_us=50_000)
    recorded = [(i, bench.seal, drive(5, i, APPLY | ANSWER, FAR, seal=bench.seal)) for i in (2**32 - 4, 2**32 - 3)]
    sequence = 2**32 - 5
    for _ in range(2**32 // 2_000_000):
        sequence += 2_000_000
        bench.seal = bench.seal._replace(turn=sequence // 2**32)
        bench.sample(ANSWER, sequence=sequence % 2**32)
    assert sequence % 2**32 < recorded[0][0] < sequence % 2**32 + 2_000_000
    if bench.seal.key:
        assert [bench.send_bytes(content) for _, _, content in recorded] == [b""] * 2
        assert bench.codes == SAFE
    assert flags(bench.drive(APPLY | ANSWER, [7, 7], sequence=recorded[0][0])) == READY
    assert bench.codes == [7, 7]
    bench.seal = bench.seal._replace(turn=2)
    assert flags(bench.drive(PARK | ANSWER, sequence=3)) == 0
    assert isinstance(bench.drive(PARK | ANSWER, sequence=4), Sample)
