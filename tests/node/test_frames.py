"""Every field of every frame of the protocol, and invalid frames, which the node only counts."""

from __future__ import annotations

import ctypes
import random
import struct
import zlib

import pytest

from tests.node.bench import BOOT, INPUTS, LONGEST_HOLD_US, OUTPUTS, SAFE, Bench, open_node
from tests.node.frames import (
    ANSWER,
    APPLY,
    AT_SAFE,
    DRIVE,
    DRIVEN,
    HELLO,
    KEYED,
    OPEN,
    READY,
    SAMPLE,
    VERSION,
    Refusal,
    Sample,
    Welcome,
    drive,
    frame,
    hello,
)


def test_the_check_is_that_of_zlib(library: ctypes.CDLL):
    assert library.bench_crc32(b"123456789", ctypes.c_size_t(9)) == 0xCBF43926  # the check value of CRC-32
    numbers = random.Random(1)
    for length in range(200):
        content = numbers.randbytes(length)
        assert library.bench_crc32(content, ctypes.c_size_t(length)) == zlib.crc32(content)


def test_welcome_says_what_the_node_is(bench: Bench):
    kept, channels = KEYED if bench.seal.key else 0, [*INPUTS, *OUTPUTS]
    expected = Welcome(9, 2**32 - 1, 2, (2, 2, 3, 4), BOOT, LONGEST_HOLD_US, 50, kept, 0, channels)
    assert bench.send(hello(2**32 - 1, sequence=9)) == expected
    bench.open()
    assert bench.send(hello(2**32 - 1, sequence=9)) == expected._replace(flags=kept | DRIVEN, opening=1)
    assert bench.send(hello(5, sequence=9)) == expected._replace(session=5, flags=kept | DRIVEN)
    assert len(bench.send_bytes(hello())) == 52 + 32 * 4


def test_hello_changes_nothing(bench: Bench):
    bench.open_and_set([5, 5], hold_us=3000)
    before = bench.counters
    for _ in range(3):
        bench.now_us += 900
        assert isinstance(bench.send(hello(6), sender=1), Welcome)
    assert bench.counters == before
    bench.poll(300)
    assert bench.counters.watchdog_trips == 1


@pytest.mark.parametrize("version", [0, 1, 3, 258, 65535])
def test_a_hello_of_another_version_is_refused(bench: Bench, version: int):
    assert bench.send(hello(6, version, 3)) == Refusal(3, 6, BOOT, VERSION)
    assert bench.counters.refused == 1


def test_a_safe_code_and_a_change_of_an_input_are_0_in_welcome(bench: Bench):
    bench.start(inputs=[INPUTS[0]._replace(safe=7, change_per_ms=9)])
    answer = bench.send(hello())
    assert isinstance(answer, Welcome)
    assert answer.channels[0] == INPUTS[0]


def test_the_largest_node_fits_into_one_ethernet_frame(bench: Bench):
    assert bench.start(inputs=INPUTS[:1] * 22, outputs=OUTPUTS[:1] * 22, digital=(16, 16))
    assert len(bench.send_bytes(hello())) == 1460
    codes = list(range(22))
    bench.set_inputs([-code for code in codes], 0xFFFF)
    bench.open(codes=codes)
    answer = bench.sample(APPLY | ANSWER, codes, digital=0xFFFF)
    assert (bench.codes, bench.digital) == (codes, 0xFFFF)
    assert (list(answer.codes), answer.digital) == ([-code for code in codes], 0xFFFF)


def test_a_sample_has_inputs_from_before_the_outputs_were_set(bench: Bench):
    bench.set_inputs([-123456, 2**31 - 1], 0b1111_0101, conversion_ns=1500)
    bench.open()
    writes = bench.counters.writes
    answer = bench.drive(APPLY | ANSWER, [-9, 8], digital=0b1_0110)
    expected = Sample(bench.sequence, 5, BOOT, READY, 0b101, 1500, bench.sequence, (-123456, 2**31 - 1))
    assert answer == expected
    assert bench.counters.writes_at_read == writes == bench.counters.writes - 1
    assert (bench.codes, bench.digital) == ([-9, 8], 0b110)
    applied = bench.sequence
    assert bench.drive(ANSWER) == expected._replace(sequence=bench.sequence, applied=applied)


def test_an_age_beyond_its_field_is_its_largest_value(bench: Bench):
    bench.set_inputs([0, 0], conversion_ns=2**33)
    assert bench.open().age_ns == 2**32 - 1


def test_applied_is_0_until_codes_are_applied_and_from_the_ramp_on(bench: Bench):
    assert bench.open().applied == 0
    answer = bench.sample(APPLY | ANSWER, [1, 1])
    assert answer.applied == bench.sequence
    answer = bench.sample(OPEN | ANSWER)
    assert (answer.applied, answer.flags) == (0, 0)


def test_a_drive_without_answer_is_not_answered_and_converts_nothing(bench: Bench):
    bench.open()
    reads = bench.counters.reads
    assert bench.drive(APPLY, [1, 1]) is None
    assert bench.codes == [1, 1]
    assert bench.counters.reads == reads


def test_codes_at_the_safe_codes_are_at_safe_in_any_session(bench: Bench):
    bench.open()
    answer = bench.sample(APPLY | ANSWER, SAFE)
    assert answer.flags == READY | AT_SAFE


GOOD = drive(5, 2, APPLY | ANSWER, [9, 9])


def _with_crc(content: bytes) -> bytes:
    """Return the bytes followed by their CRC."""
    return content + struct.pack("<I", zlib.crc32(content))


@pytest.mark.parametrize(
    "content",
    [
        *(GOOD[:length] for length in range(len(GOOD))),
        *(
            bytes(byte ^ (1 << bit) * (i == place) for i, byte in enumerate(GOOD))
            for place in range(len(GOOD))
            for bit in (0, 7)
        ),
        GOOD + b"\0",
        _with_crc(GOOD[:-4] + b"\0"),
        _with_crc(GOOD[:-5]),
        _with_crc(GOOD[:-4] + bytes(4)),
        _with_crc(b"\x7a" + GOOD[1:-4]),
        _with_crc(GOOD[:3] + b"\2" + GOOD[4:-4]),
        *(frame(kind, 2, GOOD[8:-12]) for kind in range(256) if kind != DRIVE),
        frame(HELLO, 2, bytes(9)),
        frame(HELLO, 2, bytes(7)),
        frame(DRIVE, 2, b""),
        _with_crc(b""),
        bytes(len(GOOD)),
        _with_crc(GOOD[:-12]),
        _with_crc(GOOD[:-8]),
        GOOD[:-4] + bytes(4),
    ],
)
def test_a_frame_that_is_not_valid_is_counted_and_moves_nothing(bench: Bench, content: bytes):
    bench.open(sequence=1)
    before = bench.counters
    assert bench.send_bytes(content) == b""
    assert bench.counters == before._replace(invalid=1)


@open_node
def test_the_good_frame_of_the_test_above_is_accepted(bench: Bench):
    bench.open(sequence=1)
    assert bench.send_bytes(GOOD)[2] == SAMPLE
    assert bench.codes == [9, 9]


@pytest.mark.parametrize(
    "change",
    [
        {"inputs": []},
        {"outputs": []},
        {"inputs": INPUTS[:1] * 23, "outputs": OUTPUTS[:1] * 22},
        {"digital": (17, 0)},
        {"digital": (0, 17)},
        {"hold_us": 0},
        {"inputs": [INPUTS[0]._replace(lowest=1, highest=0)]},
        {"outputs": [OUTPUTS[0]._replace(safe=32768)]},
        {"outputs": [OUTPUTS[0]._replace(safe=-32769)]},
        {"outputs": [OUTPUTS[0]._replace(change_per_ms=0)]},
        {"key": bytes(16)},
        {"key": b"\xff" * 16},
    ],
)
def test_a_node_that_the_protocol_does_not_allow_does_not_start(bench: Bench, change: dict):
    writes = bench.counters.writes
    assert not bench.start(**change)
    assert bench.counters.writes == writes


def test_a_clock_of_32_bits_is_extended_over_its_wrap(library: ctypes.CDLL):
    time_us = 5 * 2**32 + 0xFFFF_FF00
    for clock_us, wraps in ((0xFFFF_FFFF, 5), (0x10, 6), (0x10, 6)):
        time_us = library.bench_extend_us(ctypes.c_uint64(time_us), ctypes.c_uint32(clock_us))
        assert time_us == wraps * 2**32 + clock_us
