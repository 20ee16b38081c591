"""Frames and arrivals as a relay between driver and node sees them, written from docs/node-protocol.md alone."""

from __future__ import annotations

import struct
import zlib
from typing import NamedTuple, Protocol

from tests.node.frames import DRIVE

LOOP, STRANGER = "loop", "stranger"
"""Names of the two senders from which the node receives datagrams."""


class Node(Protocol):
    """Interface of a node without a line: the relay calls it with each datagram."""

    key: str | None
    """Path of the file with its key; None without a key."""

    def receive(self, data: bytes, sender: str, now_us: int) -> bytes:
        """Process a datagram at a time; return the answer, or no bytes."""
        ...

    @property
    def outputs(self) -> tuple[int, ...]:
        """Present codes of the outputs."""
        ...

    @property
    def counts(self) -> tuple[int, int]:
        """Number of invalid frames, and of parkings by the watchdog."""
        ...


class DriveFrame(NamedTuple):
    """Fields of a DRIVE that the relay reads."""

    sequence: int
    session: int
    flags: int
    codes: tuple[int, ...]


def parse_drive(data: bytes) -> DriveFrame | None:
    """Return the fields of a DRIVE; None for another frame."""
    if len(data) < 36 or data[2] != DRIVE:
        return None
    assert struct.unpack("<I", data[-4:])[0] == zlib.crc32(data[:-4])
    sequence, session, flags, count = struct.unpack_from("<IIBB", data, 4)
    return DriveFrame(sequence, session, flags, struct.unpack(f"<{count}i", data[24:-12]))


class Arrival(NamedTuple):
    """A datagram that arrived at the loop; `kind` is "sample", "refusal", "invalid", "foreign" or "stranger"."""

    kind: str
    sequence: int = 0
    codes: tuple[int, ...] = ()


def drive_content(session: int, flags: int, codes: tuple[int, ...]) -> bytes:
    """Return the bytes of a DRIVE between its sequence and its tag."""
    return struct.pack(f"<IBBHII{len(codes)}i", session, flags, len(codes), 0, 50_000, 0, *codes)


def sample_content(session: int, boot: int, codes: tuple[int, ...]) -> bytes:
    """Return the bytes of a SAMPLE between its sequence and its tag."""
    return struct.pack(f"<IIBBHII{len(codes)}i", session, boot, 1, len(codes), 0, 0, 0, *codes)


def refusal_content(session: int, boot: int) -> bytes:
    """Return the bytes of a REFUSAL, BUSY for a DRIVE with the tag 7, between its sequence and its tag."""
    return struct.pack("<IIHHIQ", session, boot, 2, 2, 1, 7)
