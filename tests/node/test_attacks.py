"""Frames of an attacker without the key, between those of a loop: no output follows them, and each PARK is obeyed.

The attacker has recorded all frames of this and of earlier sessions and boots, sends from the loop's address too, and
has even DRIVEs with the right key for other boots, openings and turns.
"""

from __future__ import annotations

import ctypes
import random
import struct
import zlib

import pytest

from tests.node.bench import KEY, LOOP, OTHER, OUTPUTS, SAFE, Bench, keyed_node
from tests.node.frames import (
    ANSWER,
    APPLY,
    AT_SAFE,
    OPEN,
    PARK,
    READY,
    Sample,
    Seal,
    Welcome,
    cobs,
    drive,
    hello,
    parse,
)

LONGEST = 36 + 4 * 255
ACTS = (OPEN, APPLY, APPLY, 0, PARK)
HOLD_US = 40_000
FIELDS = ((4, "<I"), (8, "<I"), (12, "<B"), (14, "<H"), (16, "<I"), (20, "<I"), (24, "<i"), (28, "<i"), (32, "<Q"))
"""Offset and type of the fields of a DRIVE for two outputs."""


class SerialLine:
    """The line to a node: frames in COBS, which the node's receiver decodes. Both write whole lines to it."""

    def __init__(self, bench: Bench, draw: random.Random) -> None:
        self._bench, self._draw = bench, draw
        self._receiver = ctypes.c_void_p(bench.library.cobs_new())
        self._frame = ctypes.create_string_buffer(LONGEST)

    def send(self, content: bytes, sender: int | None) -> bytes:
        """Send a frame; a line of the attacker, which has a sender, is damaged at times. Returns the node's answer."""
        line = cobs(content)
        if sender is not None and self._draw.random() < 0.2:
            damaged = bytearray(self._draw.randbytes(self._draw.randrange(20)) + line)
            damaged[self._draw.randrange(len(damaged))] = self._draw.randrange(256)
            line = bytes(damaged) + b"\0"
        answer = b""
        for byte in line:
            if length := self._bench.library.cobs_receive(self._receiver, ctypes.c_uint8(byte), self._frame):
                answer = self._bench.send_bytes(self._frame.raw[:length])
        return answer


class Attacked:
    """A node with a loop and an attacker. All frames, times and codes are chosen by `draw`."""

    def __init__(self, bench: Bench, draw: random.Random, *, is_serial: bool) -> None:
        self.bench, self.draw = bench, draw
        self._line = SerialLine(bench, draw) if is_serial else None
        self.history: list[bytes] = []
        self.attacks = self.parks = 0
        self.session = self.sequence = self.boot = 1
        self.expected = list(SAFE)
        self.seal = Seal(KEY)

    def restart(self) -> None:
        """Start the node with a boot that it has not had."""
        self.boot += 1
        assert self.bench.start(boot=self.boot, key=KEY)
        self.expected = list(SAFE)

    def _send_bytes(self, content: bytes, sender: int | None = None) -> bytes:
        """Send a frame, by `sender` if it is the attacker's; return the node's answer."""
        if self._line:
            return self._line.send(content, sender)
        return self.bench.send_bytes(content, LOOP if sender is None else sender)

    def send(self, act: int, codes: list[int], sequence: int) -> Sample:
        """Send a DRIVE of the loop, which the node must accept, and record it.

        The sequence goes on beyond 32 bits.
        """
        self.sequence = sequence
        turn, sequence = divmod(sequence, 2**32)
        content = drive(self.session, sequence, act | ANSWER, codes, 0, HOLD_US, self.seal._replace(turn=turn))
        self.history.append(content)
        answer = self._send_bytes(content)
        sample = parse(answer, self.seal._replace(turn=turn))
        assert isinstance(sample, Sample)
        return sample

    def open(self) -> None:
        """Open a session from a sequence that is at times near its end, at times with the number of an earlier one."""
        draw = self.draw
        self.session = draw.choice((self.session, draw.randint(1, 2**32 - 1)))
        self.sequence = draw.choice((0, draw.getrandbits(32), 2**32 - draw.randint(2, 40)))
        self.seal = Seal(KEY, self.boot)
        welcome = parse(self._send_bytes(hello(self.session)), self.seal)
        assert isinstance(welcome, Welcome)
        self.seal = self.seal._replace(opening=welcome.opening)
        assert self.send(OPEN, SAFE, self.sequence).flags == READY | AT_SAFE

    def forged(self) -> bytes:
        """Return a frame that is not the loop's next one."""
        draw = self.draw
        kind = draw.randrange(8)
        if kind < 3 and self.history:  # an old or a recorded frame
            return draw.choice(self.history[-40:] if kind else self.history)
        codes = [draw.randint(-500, 32767) for _ in OUTPUTS]
        sequence = (self.sequence + draw.choice((1, 1, 2, 40_000, 2**30, 2**31, draw.getrandbits(32)))) % 2**32
        session = draw.choice((self.session,) * 5 + (0, draw.getrandbits(32)))
        seal = self.seal._replace(turn=(self.sequence + 1) // 2**32)
        if kind == 3:
            seal = Seal(draw.randbytes(16), *seal[1:])
        elif kind == 4:
            field = draw.choice(("boot", "opening", "turn"))
            session = self.session
            seal = seal._replace(**{field: getattr(seal, field) + draw.choice((2, 3, 2**31, -2))})
        elif kind == 5 or not self.history:
            return draw.choice((draw.randbytes(draw.randrange(60)), hello(session, draw.choice((1, 2)), sequence)))
        elif kind == 6:
            seal = Seal()
        else:  # a recorded frame with other fields, at times cut
            content = bytearray(draw.choice(self.history[-40:]))
            for offset, form in draw.sample(FIELDS, draw.randint(1, 3)):
                size = struct.calcsize(form)
                content[offset : offset + size] = draw.randbytes(size)
            content = content[: len(content) - draw.choice((4, 4, 4, 8, 12))]
            return bytes(content) + struct.pack("<I", zlib.crc32(content))
        hold_us = draw.choice((1, HOLD_US, 2**32 - 1))
        return drive(session, sequence, draw.choice(ACTS) | draw.choice((0, ANSWER)), codes, 0xFFFF, hold_us, seal)

    def attack(self, count: int) -> None:
        """Send frames of the attacker, and require after each that the board was not written."""
        writes = self.bench.counters.writes
        for _ in range(count):
            content = self.forged()
            self._send_bytes(content, self.draw.choice((LOOP, LOOP, OTHER)))
            assert self.bench.counters.writes == writes, content.hex()
        self.attacks += count
        assert self.bench.codes == self.expected

    def drive_under_attack(self) -> None:
        """Open a session, drive, and park by a frame of any sequence; attack before, between and after all of these."""
        draw = self.draw
        self.attack(draw.randrange(40))
        self.open()
        for _ in range(draw.randrange(1, 12)):
            self.attack(draw.randrange(20))
            self.bench.poll(draw.randrange(HOLD_US // 2))
            codes = [draw.randint(100, 1000), draw.randint(-200, 100)]
            step = draw.choice((1, 1, 1, 2, 40_000))
            assert self.send(APPLY, codes, self.sequence + step).flags & READY
            self.expected = codes
        self.attack(draw.randrange(20))
        start_of_turn = self.sequence // 2**32 * 2**32
        self.send(PARK, SAFE, draw.choice((self.sequence + 1, draw.randint(start_of_turn, self.sequence))))
        self.parks += 1
        while self.expected != SAFE:
            self.attack(draw.randrange(3))
            self.bench.poll(999)
            self.attack(draw.randrange(3))
            pairs = zip(self.expected, OUTPUTS, strict=True)
            self.expected = [max(channel.safe, code - channel.change_per_ms) for code, channel in pairs]
            self.bench.poll(1)
            assert self.bench.codes == self.expected
        assert self.send(PARK, SAFE, self.sequence + 1).flags == AT_SAFE
        if draw.random() < 0.1:
            self.restart()


def attack_a_node(bench: Bench, seed: int, count: int, *, is_serial: bool) -> None:
    """Let a loop run session after session until the attacker has sent `count` frames."""
    attacked = Attacked(bench, random.Random(seed), is_serial=is_serial)
    attacked.restart()
    while attacked.attacks < count:
        attacked.drive_under_attack()
        attacked.history = attacked.history[-4000:]
    assert attacked.parks > count // 1000


@keyed_node
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("is_serial", [False, True], ids=["udp", "serial"])
def test_no_output_follows_an_attacker_and_each_park_is_obeyed(bench: Bench, seed: int, is_serial: bool):
    attack_a_node(bench, seed, 10_000, is_serial=is_serial)


@keyed_node
@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("is_serial", [False, True], ids=["udp", "serial"])
def test_no_output_follows_a_million_frames_of_an_attacker(bench: Bench, is_serial: bool):
    attack_a_node(bench, 3, 1_000_000, is_serial=is_serial)
