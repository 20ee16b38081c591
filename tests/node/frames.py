"""Frames between loop and node, written from docs/node-protocol.md alone: the oracle of the library in deploy/node."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import NamedTuple

HELLO, WELCOME, DRIVE, SAMPLE, REFUSAL = range(0x70, 0x75)
OPEN, APPLY, ANSWER, PARK = 1, 2, 4, 8
READY, AT_SAFE = 1, 2
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
    driven: int
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
    version: int


def frame(kind: int, sequence: int, content: bytes) -> bytes:
    """Return the bytes of a frame: header, content, CRC."""
    body = struct.pack("<HBBI", 0x057B, kind, 1, sequence % 2**32) + content
    return body + struct.pack("<I", zlib.crc32(body))


def hello(session: int = 5, version: int = 1, sequence: int = 1) -> bytes:
    """Return the bytes of a HELLO, which asks for a WELCOME."""
    return frame(HELLO, sequence, struct.pack("<IHH", session, version, 0))


def drive(
    session: int, sequence: int, flags: int, codes: Sequence[int], digital: int = 0, hold_us: int = 10_000
) -> bytes:
    """Return the bytes of a DRIVE, which sets outputs and asks for a SAMPLE by `flags`."""
    head = struct.pack("<IBBHII", session, flags, len(codes), digital, hold_us, 0)
    return frame(DRIVE, sequence, head + struct.pack(f"<{len(codes)}i", *codes))


def parse(answer: bytes) -> Welcome | Sample | Refusal | None:
    """Return the fields of a node's answer, None for no answer. Raises AssertionError for an invalid frame."""
    if not answer:
        return None
    magic, kind, batches, sequence = struct.unpack_from("<HBBI", answer)
    assert (magic, batches) == (0x057B, 1)
    assert struct.unpack("<I", answer[-4:])[0] == zlib.crc32(answer[:-4])
    if kind == REFUSAL:
        session, boot, reason, version, zero = struct.unpack("<IIHHI", answer[8:-4])
        assert zero == 0
        return Refusal(sequence, session, boot, reason, version)
    if kind == SAMPLE:
        session, boot, flags, inputs, digital, age_ns, applied = struct.unpack_from("<IIBBHII", answer, 8)
        codes = struct.unpack(f"<{inputs}i", answer[28:-4])
        return Sample(sequence, session, boot, flags, digital, age_ns, applied, codes)
    assert kind == WELCOME
    session, version, *counts, zero, boot, hold, period, driven = struct.unpack_from("<IH4BHIIII", answer, 8)
    assert zero == 0
    assert len(answer) == 40 + 32 * (counts[0] + counts[1])
    channels = [Channel(*fields) for fields in struct.iter_unpack("<iiiIdd", answer[36:-4])]
    n = tuple(counts)
    return Welcome(sequence, session, version, (n[0], n[1], n[2], n[3]), boot, hold, period, driven, channels)


def reason(answer: Sample | Refusal | None) -> int:
    """Return a REFUSAL's reason, 0 for a SAMPLE."""
    assert answer is not None
    return answer.reason if isinstance(answer, Refusal) else 0


def flags(answer: Sample | Refusal | None) -> int:
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
