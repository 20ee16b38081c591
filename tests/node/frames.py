"""Frames between loop and node, written from docs/node-protocol.md alone: the oracle of the library in deploy/node."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import NamedTuple

HELLO, WELCOME, DRIVE, SAMPLE, REFUSAL = range(0x70, 0x75)
OPEN, APPLY, ANSWER, PARK = 1, 2, 4, 8
READY, AT_SAFE = 1, 2
DRIVEN, KEYED = 1, 2
VERSION, BUSY, UNKNOWN, WATCHDOG, SIZE, RANGE, FLAGS = range(1, 8)


class Channel(NamedTuple):
    """A channel of a node, with the fields of WELCOME."""

    lowest: int
    highest: int
    safe: int
    change_per_ms: int
    volts_per_code: float
    volts_at_zero: float


class Welcome(NamedTuple):
    """Fields of a WELCOME, the node's description of itself."""

    sequence: int
    session: int
    version: int
    counts: tuple[int, int, int, int]
    boot: int
    longest_hold_us: int
    shortest_period_us: int
    flags: int
    opening: int
    channels: list[Channel]


class Sample(NamedTuple):
    """Fields of a SAMPLE, the node's answer to a DRIVE."""

    sequence: int
    session: int
    boot: int
    flags: int
    digital: int
    age_ns: int
    applied: int
    codes: tuple[int, ...]


class Refusal(NamedTuple):
    """Fields of a REFUSAL, the node's answer to a frame that it refuses."""

    sequence: int
    session: int
    boot: int
    reason: int
    version: int = 2
    opening: int = 0
    tag: int = 0


def siphash(key: bytes, message: bytes, rounds: tuple[int, int] = (2, 4)) -> int:
    """Return SipHash-2-4 as section 2 of the paper writes it (Aumasson and Bernstein 2012)."""
    k = struct.unpack("<QQ", key)
    v = [k[0] ^ 0x736F6D6570736575, k[1] ^ 0x646F72616E646F6D, k[0] ^ 0x6C7967656E657261, k[1] ^ 0x7465646279746573]

    def add_and_rotate(i: int, j: int, bits: int) -> None:
        v[i] = (v[i] + v[j]) % 2**64
        v[j] = (v[j] << bits | v[j] >> 64 - bits) % 2**64 ^ v[i]

    def sip_rounds(count: int) -> None:
        for _ in range(count):
            for i, j, bits in ((0, 1, 13), (2, 3, 16)):
                add_and_rotate(i, j, bits)
            v[0] = (v[0] << 32 | v[0] >> 32) % 2**64
            for i, j, bits in ((2, 1, 17), (0, 3, 21)):
                add_and_rotate(i, j, bits)
            v[2] = (v[2] << 32 | v[2] >> 32) % 2**64

    padded = message + bytes(7 - len(message) % 8) + bytes([len(message) % 256])
    for (word,) in struct.iter_unpack("<Q", padded):
        v[3] ^= word
        sip_rounds(rounds[0])
        v[0] ^= word
    v[2] ^= 0xFF
    sip_rounds(rounds[1])
    return v[0] ^ v[1] ^ v[2] ^ v[3]


class Seal(NamedTuple):
    """What a tag depends on besides the frame; without a key each tag is 0."""

    key: bytes | None = None
    boot: int = 0
    opening: int = 0
    turn: int = 0

    def tag(self, body: bytes) -> int:
        """Return the tag of a frame whose bytes before the tag are `body`."""
        unsent = struct.pack("<III", self.boot, self.opening % 2**32, self.turn % 2**32)
        return siphash(self.key, body + unsent) if self.key else 0


UNSEALED = Seal()


def frame(kind: int, sequence: int, content: bytes, seal: Seal | None = None) -> bytes:
    """Return the bytes of a frame: header, content, tag, CRC; without a seal there is no tag."""
    body = struct.pack("<HBBI", 0x057B, kind, 1, sequence % 2**32) + content
    body += struct.pack("<Q", seal.tag(body)) if seal else b""
    return body + struct.pack("<I", zlib.crc32(body))


def hello(session: int = 5, version: int = 2, sequence: int = 1) -> bytes:
    """Return the bytes of a HELLO, which asks for a WELCOME."""
    return frame(HELLO, sequence, struct.pack("<IHH", session, version, 0))


def drive(
    session: int,
    sequence: int,
    flags: int,
    codes: Sequence[int],
    digital: int = 0,
    hold_us: int = 10_000,
    seal: Seal = UNSEALED,
) -> bytes:
    """Return the bytes of a DRIVE, which sets outputs and asks for a SAMPLE by `flags`."""
    head = struct.pack("<IBBHII", session, flags, len(codes), digital, hold_us, 0)
    return frame(DRIVE, sequence, head + struct.pack(f"<{len(codes)}i", *codes), seal)


def parse(answer: bytes, seal: Seal = UNSEALED) -> Welcome | Sample | Refusal | None:
    """Return the fields of a node's answer, None for no answer.

    Raises AssertionError for an invalid frame, and for a tag that is not the seal's; WELCOME and REFUSAL say their boot
    and opening themselves.
    """
    if not answer:
        return None
    magic, kind, batches, sequence = struct.unpack_from("<HBBI", answer)
    assert (magic, batches) == (0x057B, 1)
    assert struct.unpack("<I", answer[-4:])[0] == zlib.crc32(answer[:-4])
    content, tag = answer[8:-12], struct.unpack("<Q", answer[-12:-4])[0]
    fields: Welcome | Sample | Refusal
    if kind == REFUSAL and len(answer) == 28:
        *owner, zero = struct.unpack("<IIHHI", answer[8:-4])
        assert (owner[2], zero) == (VERSION, 0)
        return Refusal(sequence, *owner)
    if kind == REFUSAL:
        fields = Refusal(sequence, *struct.unpack("<IIHHIQ", content))
        seal = Seal(seal.key, fields.boot, fields.opening)
    elif kind == SAMPLE:
        session, boot, flags, inputs, digital, age_ns, applied = struct.unpack_from("<IIBBHII", content)
        codes = struct.unpack(f"<{inputs}i", content[20:])
        fields = Sample(sequence, session, boot, flags, digital, age_ns, applied, codes)
    else:
        assert kind == WELCOME
        session, version, a, b, c, d, zero, boot, *numbers = struct.unpack_from("<IH4BHIIIII", content)
        hold_us, period_us, flags, opening = numbers
        assert zero == 0
        assert len(answer) == 52 + 32 * (a + b)
        channels = [Channel(*values) for values in struct.iter_unpack("<iiiIdd", content[32:])]
        fields = Welcome(sequence, session, version, (a, b, c, d), boot, hold_us, period_us, flags, opening, channels)
        seal = Seal(seal.key, boot, fields.opening)
    assert tag == seal.tag(answer[:-12])
    return fields


def reason(answer: Welcome | Sample | Refusal | None) -> int:
    """Return a REFUSAL's reason, 0 for a SAMPLE."""
    assert isinstance(answer, Sample | Refusal)
    return answer.reason if isinstance(answer, Refusal) else 0


def flags(answer: Welcome | Sample | Refusal | None) -> int:
    """Return the flags of an answer that must be a SAMPLE."""
    assert isinstance(answer, Sample)
    return answer.flags


def cobs(content: bytes) -> bytes:
    """Return the bytes of a frame on a serial line, with the final byte 0 (Cheshire and Baker 1999)."""
    line = bytearray()
    blocks = content.split(b"\0")
    for number, block in enumerate(blocks, start=1):
        for start in range(0, len(block) - 253, 254):
            line += b"\xff" + block[start : start + 254]
        last = block[len(block) // 254 * 254 :]
        if last or not block or number < len(blocks):
            line += bytes([len(last) + 1]) + last
    return bytes(line) + b"\0"


def uncobs(line: bytes) -> bytes:
    """Return the frame in the bytes before a byte 0. Raises ValueError for a frame that was cut."""
    content = bytearray()
    place = 0
    while place < len(line):
        code = line[place]
        block = line[place + 1 : place + code]
        if len(block) != code - 1 or 0 in block:
            raise ValueError("cut")
        content += block
        place += code
        if code != 255 and place < len(line):
            content.append(0)
    return bytes(content)
