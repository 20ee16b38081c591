"""Frames between loop and node, as docs/node-protocol.md describes them: pack and unpack for Python.

Compiled code reads and writes the same bytes through the dtypes DRIVE and SAMPLE.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rtloop.drivers.node.tags import TAG_BYTES, Seal, tag_of

MAGIC, BATCHES, VERSION = 0x057B, 1, 2
HELLO, WELCOME, DRIVE_FORMAT, SAMPLE_FORMAT, REFUSAL_FORMAT = 0x70, 0x71, 0x72, 0x73, 0x74
OPEN, APPLY, ANSWER, PARK = 1, 2, 4, 8
READY, AT_SAFE = 1, 2
DRIVEN, KEYED = 1, 2
REFUSALS = {
    1: "VERSION", 2: "BUSY", 3: "UNKNOWN", 4: "WATCHDOG", 5: "SIZE", 6: "RANGE", 7: "FLAGS",
}  # fmt: skip
"""Names of the reasons of a refusal by their numbers."""
VERSION_REFUSED, BUSY, UNKNOWN, WATCHDOG, SIZE, RANGE, FLAGS = REFUSALS
MAX_CHANNELS, MAX_DIGITAL, MAX_SESSION = 44, 16, 2**32 - 1
MAX_FRAME_BYTES = 52 + 32 * MAX_CHANNELS
CRC_BYTES = 4
END_BYTES = TAG_BYTES + CRC_BYTES
"""Bytes of tag and check."""

_HEADER_FIELDS = [("magic", "<u2"), ("format", "u1"), ("batches", "u1"), ("sequence", "<u4"), ("session", "<u4")]
DRIVE = np.dtype(
    [
        *_HEADER_FIELDS, ("bits", "u1"), ("outputs", "u1"), ("digital", "<u2"), ("hold_us", "<u4"), ("zero", "<u4"),
    ]
)  # fmt: skip
"""Layout of a DRIVE up to its codes."""
SAMPLE = np.dtype(
    [
        *_HEADER_FIELDS, ("boot", "<u4"), ("bits", "u1"), ("inputs", "u1"), ("digital", "<u2"),
        ("age_ns", "<u4"), ("applied", "<u4"),
    ]
)  # fmt: skip
"""Layout of a SAMPLE up to its codes."""
REFUSAL = np.dtype(
    [
        *_HEADER_FIELDS, ("boot", "<u4"), ("reason", "<u2"), ("version", "<u2"), ("opening", "<u4"),
        ("drive_tag", "<u8"),
    ]
)  # fmt: skip
"""Layout of a REFUSAL up to its tag."""
DRIVE_HEAD, SAMPLE_HEAD, REFUSAL_BYTES = DRIVE.itemsize, SAMPLE.itemsize, REFUSAL.itemsize + END_BYTES
"""Bytes before the codes of a DRIVE and of a SAMPLE, and of a whole REFUSAL."""

_HEADER = struct.Struct("<HBBII")
_HELLO = struct.Struct("<HH")
_WELCOME = struct.Struct("<HBBBBHIIIII")
_CHANNEL = struct.Struct("<iiiIdd")
_DRIVE = struct.Struct("<BBHII")
_SAMPLE = struct.Struct("<IBBHII")
_REFUSAL = struct.Struct("<IHHI")
_VERSION_REFUSAL_BYTES = _HEADER.size + _REFUSAL.size + CRC_BYTES


class Header(NamedTuple):
    """Format, sequence and session of a frame."""

    format: int
    sequence: int
    session: int


class Scale(NamedTuple):
    """A channel of a node: range and safe value as codes, largest change of the code in 1 ms of a ramp, and the volts
    of a code: `offset_v` + code · `volts_per_code`.
    """

    lowest: int
    highest: int
    safe: int
    change_per_ms: int
    volts_per_code: float
    offset_v: float

    def volts(self, code: int) -> float:
        """Return the volts of a code."""
        return self.offset_v + code * self.volts_per_code


class Welcome(NamedTuple):
    """A node's description of itself.

    `boot` is a number that differs after each start of the node, `hold_us` the longest time that it holds its outputs
    without a DRIVE, `period_us` the shortest period of a loop, `flags` a sum of DRIVEN and KEYED, `opening` the number
    of sessions since the start.
    """

    session: int
    version: int
    boot: int
    hold_us: int
    period_us: int
    flags: int
    opening: int
    inputs: tuple[Scale, ...]
    outputs: tuple[Scale, ...]
    digital_inputs: int
    digital_outputs: int


class Drive(NamedTuple):
    """Fields of a DRIVE; `hold_us` is the time without a further DRIVE after which the node parks."""

    sequence: int
    session: int
    flags: int
    digital: int
    hold_us: int
    codes: tuple[int, ...]


class Sample(NamedTuple):
    """Fields of a SAMPLE; `applied` is the sequence of the DRIVE whose codes are at the outputs."""

    sequence: int
    session: int
    boot: int
    flags: int
    digital: int
    age_ns: int
    applied: int
    codes: tuple[int, ...]


class Refusal(NamedTuple):
    """Fields of a REFUSAL; `reason` is a key of REFUSALS, `drive_tag` the tag of the DRIVE that is refused.

    A REFUSAL for VERSION_REFUSED has neither `opening` nor `drive_tag`.
    """

    sequence: int
    session: int
    boot: int
    reason: int
    version: int
    opening: int = 0
    drive_tag: bytes = bytes(TAG_BYTES)


def _frame(format_number: int, sequence: int, session: int, content: bytes, seal: Seal | None = None) -> bytes:
    """Return the bytes of a frame: header, `content`, tag, CRC-32; without a `seal` it has no tag."""
    data = _HEADER.pack(MAGIC, format_number, BATCHES, sequence, session) + content
    data += b"" if seal is None else tag_of(data, seal)
    return data + struct.pack("<I", zlib.crc32(data))


def tag_in(data: bytes) -> bytes:
    """Return the tag in the bytes of a whole frame; HELLO and a REFUSAL for VERSION_REFUSED have none."""
    return data[-END_BYTES:-CRC_BYTES]


def is_genuine(data: bytes, seal: Seal) -> bool:
    """Whether the tag in a whole frame is right; True without a key."""
    return seal.key is None or tag_in(data) == tag_of(data[:-END_BYTES], seal)


def hello(sequence: int, session: int) -> bytes:
    """Return the bytes of a HELLO, the loop's request for a node's description; it contains the loop's VERSION."""
    return _frame(HELLO, sequence, session, _HELLO.pack(VERSION, 0))


def welcome(sequence: int, facts: Welcome, key: bytes | None = None) -> bytes:
    """Return the bytes of a WELCOME, the node's description that answers the HELLO `sequence`."""
    content = _WELCOME.pack(
        facts.version, len(facts.inputs), len(facts.outputs), facts.digital_inputs, facts.digital_outputs, 0,
        facts.boot, facts.hold_us, facts.period_us, facts.flags, facts.opening,
    )  # fmt: skip
    content += b"".join(_CHANNEL.pack(*scale) for scale in (*facts.inputs, *facts.outputs))
    return _frame(WELCOME, sequence, facts.session, content, Seal(key, facts.boot, facts.opening))


def drive(content: Drive, seal: Seal) -> bytes:
    """Return the bytes of a DRIVE, with which the loop sends flags and the codes of the outputs to the node."""
    sequence, session, flags, digital, hold_us, codes = content
    packed = _DRIVE.pack(flags, len(codes), digital, hold_us, 0) + _pack_codes(codes)
    return _frame(DRIVE_FORMAT, sequence, session, packed, seal)


def sample(content: Sample, seal: Seal) -> bytes:
    """Return the bytes of a SAMPLE, with which the node answers a DRIVE by the codes of its inputs."""
    sequence, session, boot, flags, digital, age_ns, applied, codes = content
    packed = _SAMPLE.pack(boot, flags, len(codes), digital, age_ns, applied) + _pack_codes(codes)
    return _frame(SAMPLE_FORMAT, sequence, session, packed, seal)


def refusal(content: Refusal, key: bytes | None = None) -> bytes:
    """Return the bytes of a REFUSAL, with which the node answers a frame that it does not obey."""
    sequence, session, boot, reason, version, opening, drive_tag = content
    packed = _REFUSAL.pack(boot, reason, version, opening)
    if reason == VERSION_REFUSED:
        return _frame(REFUSAL_FORMAT, sequence, session, packed)
    return _frame(REFUSAL_FORMAT, sequence, session, packed + drive_tag, Seal(key, boot, opening))


def read_header(data: bytes) -> Header | None:
    """Return a frame's header; None for bytes that are no frame: too few, another magic number, a wrong check."""
    if len(data) < _HEADER.size + CRC_BYTES:
        return None
    magic, format_number, batches, sequence, session = _HEADER.unpack_from(data)
    if magic != MAGIC or batches != BATCHES or struct.unpack("<I", data[-CRC_BYTES:])[0] != zlib.crc32(data[:-4]):
        return None
    return Header(format_number, sequence, session)


def read_hello(data: bytes) -> int | None:
    """Return the protocol version in a HELLO that `read_header` has accepted; None for a wrong length."""
    return _HELLO.unpack_from(data, _HEADER.size)[0] if len(data) == _HEADER.size + _HELLO.size + CRC_BYTES else None


def read_welcome(data: bytes) -> Welcome | None:
    """Return the content of a WELCOME that `read_header` has accepted; None if its length does not fit its counts."""
    start = _HEADER.size + _WELCOME.size
    if len(data) < start:
        return None
    fields = _WELCOME.unpack_from(data, _HEADER.size)
    version, inputs, outputs, digital_inputs, digital_outputs, _, boot, hold_us, period_us, flags, opening = fields
    if len(data) != start + _CHANNEL.size * (inputs + outputs) + END_BYTES:
        return None
    scales = tuple(Scale(*_CHANNEL.unpack_from(data, start + i * _CHANNEL.size)) for i in range(inputs + outputs))
    session = _HEADER.unpack_from(data)[4]
    return Welcome(
        session, version, boot, hold_us, period_us, flags, opening, scales[:inputs], scales[inputs:],
        digital_inputs, digital_outputs,
    )  # fmt: skip


def read_drive(data: bytes) -> Drive | None:
    """Return the content of a DRIVE that `read_header` has accepted; None if its length does not fit its count."""
    start = _HEADER.size + _DRIVE.size
    if len(data) < start:
        return None
    flags, count, digital, hold_us, _ = _DRIVE.unpack_from(data, _HEADER.size)
    codes = _unpack_codes(data, start, count)
    _, _, _, sequence, session = _HEADER.unpack_from(data)
    return None if codes is None else Drive(sequence, session, flags, digital, hold_us, codes)


def read_sample(data: bytes) -> Sample | None:
    """Return the content of a SAMPLE that `read_header` has accepted; None if its length does not fit its count."""
    start = _HEADER.size + _SAMPLE.size
    if len(data) < start:
        return None
    boot, flags, count, digital, age_ns, applied = _SAMPLE.unpack_from(data, _HEADER.size)
    codes = _unpack_codes(data, start, count)
    _, _, _, sequence, session = _HEADER.unpack_from(data)
    return None if codes is None else Sample(sequence, session, boot, flags, digital, age_ns, applied, codes)


def read_refusal(data: bytes) -> Refusal | None:
    """Return the content of a REFUSAL that `read_header` has accepted; None for a wrong length."""
    if len(data) not in (REFUSAL_BYTES, _VERSION_REFUSAL_BYTES):
        return None
    boot, reason, version, opening = _REFUSAL.unpack_from(data, _HEADER.size)
    if (len(data) == _VERSION_REFUSAL_BYTES) != (reason == VERSION_REFUSED):
        return None
    _, _, _, sequence, session = _HEADER.unpack_from(data)
    return Refusal(sequence, session, boot, reason, version, opening, data[-END_BYTES - TAG_BYTES : -END_BYTES])


def _pack_codes(codes: Sequence[int]) -> bytes:
    """Return the bytes of the codes, signed integers of 32 bits, little-endian."""
    return struct.pack(f"<{len(codes)}i", *codes)


def _unpack_codes(data: bytes, start: int, count: int) -> tuple[int, ...] | None:
    """Return `count` codes from byte `start` of a frame on; None unless only the frame's tag and CRC-32 follow them."""
    if len(data) != start + 4 * count + END_BYTES:
        return None
    return struct.unpack_from(f"<{count}i", data, start)


def drive_bytes(outputs: int) -> int:
    """Return the length in bytes of a DRIVE for `outputs` outputs, before COBS."""
    return DRIVE_HEAD + 4 * outputs + END_BYTES


def sample_bytes(inputs: int) -> int:
    """Return the length in bytes of a SAMPLE of `inputs` inputs, before COBS."""
    return SAMPLE_HEAD + 4 * inputs + END_BYTES
