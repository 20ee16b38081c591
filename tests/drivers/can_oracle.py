"""Frames of ISO 11898-1 bit by bit, with an 11-bit identifier: what goes over the wire, stuffed as it is sent."""

from __future__ import annotations

from collections.abc import Sequence

Bits = list[int]
FD_LENGTHS = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64]
SPACE = [1] * 3
END = [1, 0, 1, *[1] * 7, *SPACE]
"""CRC delimiter, acknowledgement, its delimiter, end of frame, space between frames."""


def bits_of(value: int, count: int) -> Bits:
    return [value >> i & 1 for i in reversed(range(count))]


def stuffed(bits: Sequence[int]) -> Bits:
    """After five equal bits, stuff bits among them, the opposite one."""
    sent: Bits = []
    run = 0
    for bit in bits:
        run = run + 1 if sent and sent[-1] == bit else 1
        sent.append(bit)
        if run == 5:
            sent.append(1 - bit)
            run = 1
    return sent


def crc15(bits: Sequence[int]) -> int:
    register = 0
    for bit in bits:
        feedback = bit ^ register >> 14
        register = register << 1 & 0x7FFF
        if feedback:
            register ^= 0x4599
    return register


def classic(identifier: int, data: bytes) -> Bits:
    """A whole classic data frame, and the space behind it."""
    head = [0, *bits_of(identifier, 11), 0, 0, 0, *bits_of(len(data), 4)]
    body = [*head, *(bit for byte in data for bit in bits_of(byte, 8))]
    return [*stuffed([*body, *bits_of(crc15(body), 15)]), *END]


def fd(identifier: int, data: bytes, crc: int = 0) -> tuple[int, int]:
    """Bits of a CAN FD frame with a switched rate: those up to the switch and behind it, and those between."""
    head = [0, *bits_of(identifier, 11), 0, 0, 1, 0, 1]
    body = [0, *bits_of(FD_LENGTHS.index(len(data)), 4), *(bit for byte in data for bit in bits_of(byte, 8))]
    dynamic = stuffed([*head, *body])
    until_switch = len(stuffed(head[:-1])) + 1
    field = [*bits_of(0b0110, 4), *bits_of(crc, 17 if len(data) <= 16 else 21)]
    fixed = [bit for i, data_bit in enumerate(field) for bit in ([1, data_bit] if i % 4 == 0 else [data_bit])]
    return until_switch + len(END), len(dynamic) - until_switch + len(fixed)


def worst(count: int) -> Bits:
    """The `count` bits that need most stuff bits: five equal ones, then four of the other kind, and so on."""
    return [0] + [(i // 4) % 2 for i in range(count - 1)]
