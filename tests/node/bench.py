"""The node's C library on a simulated board, with a clock that the test advances."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, NamedTuple

import pytest

from tests.node.frames import (
    ANSWER,
    APPLY,
    AT_SAFE,
    OPEN,
    READY,
    Channel,
    Refusal,
    Sample,
    Seal,
    Welcome,
    drive,
    hello,
    parse,
)

INPUTS = [Channel(-32768, 32767, 0, 0, 10 / 32768, 0.0), Channel(0, 65535, 0, 0, 1e-4, -1.5)]
OUTPUTS = [Channel(-32768, 32767, 100, 30, 10 / 32768, 0.0), Channel(-500, 40000, -200, 7, 2e-4, 0.25)]
SAFE = [channel.safe for channel in OUTPUTS]
FAR = [3000, 20000]
"""Codes that are 97 and 2886 steps of a ramp away from the safe ones."""
LOOP, OTHER = 0xC0A80001_1234, 0xC0A80002_1234
"""Addresses of two rival loops."""
BOOT = 0xB0070001
LONGEST_HOLD_US, PERIOD_US = 50_000, 50
KEY = bytes(range(0xA0, 0xB0))
open_node = pytest.mark.parametrize("bench", [None], indirect=True, ids=["open"])
keyed_node = pytest.mark.parametrize("bench", [KEY], indirect=True, ids=["keyed"])
"""Marks of tests for a node of one kind; without a mark a test runs for both."""


class _Channel(ctypes.Structure):
    """A channel in the memory of the C library."""

    _fields_ = [
        ("lowest", ctypes.c_int32),
        ("highest", ctypes.c_int32),
        ("safe", ctypes.c_int32),
        ("change_per_ms", ctypes.c_uint32),
        ("volts_per_code", ctypes.c_double),
        ("volts_at_zero", ctypes.c_double),
    ]


class Write(NamedTuple):
    """A write of all outputs: time by the node's clock, codes, digital outputs."""

    time_us: int
    codes: list[int]
    digital: int


class Counters(NamedTuple):
    """Counters of the node, then those of its board (from `reads` on)."""

    invalid: int
    old: int
    refused: int
    sessions: int
    watchdog_trips: int
    foreign: int
    reads: int
    writes: int
    writes_at_read: int


class Bench:
    """A node with its board; `now_us` is its clock, `seal` that of the next DRIVE, `tag` the tag of the last one."""

    def __init__(self, library: ctypes.CDLL):
        self.library = library
        self.now_us = 1_000_000
        self.sequence = 0
        self.outputs = len(OUTPUTS)
        self.seal = Seal()
        self.tag = 0
        self._bench = ctypes.c_void_p(library.bench_new())
        self._answer = ctypes.create_string_buffer(1460)

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        self.library.bench_delete(self._bench)

    def start(
        self,
        inputs: Sequence[Channel] = INPUTS,
        outputs: Sequence[Channel] = OUTPUTS,
        digital: tuple[int, int] = (3, 4),
        hold_us: int = LONGEST_HOLD_US,
        boot: int = BOOT,
        key: bytes | None = None,
        period_us: int = PERIOD_US,
    ) -> bool:
        """Start the node, and return whether it accepted its configuration; key None: that of the last start."""
        self.seal = Seal(key or self.seal.key, boot)
        self.outputs = len(outputs)
        channels = [*inputs, *outputs]
        if len(channels) <= 44:
            table = (_Channel * 44).from_address(self.library.bench_channels(self._bench))
            for place, channel in enumerate(channels):
                table[place] = _Channel(*channel)
        counts = bytes([len(inputs), len(outputs), *digital])
        return self.library.bench_start(
            self._bench,
            counts,
            ctypes.c_uint32(hold_us),
            ctypes.c_uint32(period_us),
            ctypes.c_uint32(boot),
            self.seal.key,
            ctypes.c_uint64(self.now_us),
        )

    def send_bytes(self, frame: bytes, sender: int = LOOP) -> bytes:
        """Return the bytes of the node's answer to a frame."""
        length = self.library.bench_receive(
            self._bench,
            frame,
            ctypes.c_size_t(len(frame)),
            ctypes.c_uint64(sender),
            ctypes.c_uint64(self.now_us),
            self._answer,
        )
        return self._answer.raw[:length]

    def send(self, frame: bytes, sender: int = LOOP) -> Welcome | Sample | Refusal | None:
        """Return the fields of the node's answer to a frame."""
        return parse(self.send_bytes(frame, sender), self.seal)

    def drive(
        self,
        flags: int,
        codes: Sequence[int] = SAFE,
        session: int = 5,
        sender: int = LOOP,
        *,
        sequence: int | None = None,
        digital: int = 0,
        hold_us: int = 10_000,
    ) -> Sample | Refusal | None:
        """Send the next DRIVE, or a DRIVE with a given sequence, and return the fields of the answer.

        Before an OPEN the opening is read from a WELCOME, as the protocol says it.
        """
        if flags & OPEN:
            welcome = self.send(hello(session), sender)
            assert isinstance(welcome, Welcome)
            self.seal = self.seal._replace(opening=welcome.opening)
        self.sequence = self.sequence + 1 if sequence is None else sequence
        frame = drive(session, self.sequence, flags, codes, digital, hold_us, self.seal)
        self.tag = int.from_bytes(frame[-12:-4], "little")
        answer = self.send(frame, sender)
        assert not isinstance(answer, Welcome)
        return answer

    def sample(self, *arguments: Any, **fields: Any) -> Sample:
        """Send a DRIVE as `drive` does, and return the fields of its answer, which must be a SAMPLE."""
        answer = self.drive(*arguments, **fields)
        assert isinstance(answer, Sample)
        return answer

    def open(self, **fields: Any) -> Sample:
        """Open a session and return its SAMPLE; the outputs must be at their safe codes."""
        answer = self.sample(OPEN | ANSWER, **fields)
        assert answer.flags == READY | AT_SAFE
        return answer

    def open_and_set(
        self, codes: Sequence[int], digital: int = 0, session: int = 5, sender: int = LOOP, hold_us: int = 10_000
    ) -> None:
        """Open a session and set its outputs to codes."""
        self.open(session=session, sender=sender, hold_us=hold_us)
        self.sample(APPLY | ANSWER, codes, session, sender, digital=digital, hold_us=hold_us)
        assert (self.codes, self.digital) == (list(codes), digital)

    def poll(self, step_us: int = 0) -> None:
        """Advance the clock and call the node once."""
        self.now_us += step_us
        self.library.bench_poll(self._bench, ctypes.c_uint64(self.now_us))

    def run(self, duration_us: int, step_us: int = 1000) -> None:
        """Advance the clock by steps, with a call of the node at each."""
        for _ in range(duration_us // step_us):
            self.poll(step_us)

    def park(self) -> None:
        """Make the node park, which ends the session."""
        self.library.bench_park(self._bench, ctypes.c_uint64(self.now_us))

    def set_inputs(self, codes: Sequence[int], digital: int = 0, conversion_ns: int = 0) -> None:
        """Set the board's inputs, and the duration of a conversion."""
        array = (ctypes.c_int32 * len(codes))(*codes)
        self.library.bench_set_inputs(self._bench, array, ctypes.c_uint16(digital), ctypes.c_uint64(conversion_ns))

    def writes(self, start: int = 0) -> list[Write]:
        """Return the writes of the outputs from number `start` on."""
        codes, digital = (ctypes.c_int32 * 44)(), ctypes.c_uint16()
        writes = []
        for number in range(start, self.counters.writes):
            time_us = self.library.bench_write(self._bench, ctypes.c_uint32(number), codes, ctypes.byref(digital))
            writes.append(Write(time_us, codes[: self.outputs], digital.value))
        return writes

    @property
    def counters(self) -> Counters:
        """Present counters of node and board."""
        array = (ctypes.c_uint32 * 9)()
        self.library.bench_counters(self._bench, array)
        return Counters(*array)

    @property
    def codes(self) -> list[int]:
        """Present codes of the outputs."""
        return self.writes(self.counters.writes - 1)[0].codes

    @property
    def digital(self) -> int:
        """Present digital outputs, one bit each."""
        return self.writes(self.counters.writes - 1)[0].digital

    @property
    def due_us(self) -> int:
        """Time at which the node must be called next; 2**64 − 1 if no call is due."""
        return self.library.bench_due_us(self._bench)
