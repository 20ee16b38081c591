"""CAN frames with an 11-bit identifier, built and stuffed bit by bit after ISO 11898-1: the oracle of frame lengths."""

from __future__ import annotations

from collections.abc import Sequence

Bits = list[int]
FD_LENGTHS = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64]
SPACE = [1] * 3
END = [1, 0, 1, *[1] * 7, *SPACE]
"""Bits after the CRC: CRC delimiter, acknowledgement and its delimiter, end of frame, space between frames."""


def to_bits(value: int, count: int) -> Bits:
    """Return the lowest `count` bits of a number, the highest first."""
    return [value >> i & 1 for i in reversed(range(count))]


def stuff(bits: Sequence[int]) -> Bits:
    """Return the bits with a stuff bit, the opposite one, after each five equal bits; stuff bits count as bits."""
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
    """Return the check of a classic frame: polynomial 0x4599, initial value 0."""
    register = 0
    for bit in bits:
        feedback = bit ^ register >> 14
        register = register << 1 & 0x7FFF
        if feedback:
            register ^= 0x4599
    return register


def classic_frame(identifier: int, data: bytes) -> Bits:
    """Return the bits of a classic data frame and of the space behind it."""
    head = [0, *to_bits(identifier, 11), 0, 0, 0, *to_bits(len(data), 4)]
    body = [*head, *(bit for byte in data for bit in to_bits(byte, 8))]
    return [*stuff([*body, *to_bits(crc15(body), 15)]), *END]


def fd_frame_lengths(identifier: int, data: bytes, crc: int = 0) -> tuple[int, int]:
    """Return the numbers of bits of a CAN FD frame: those at the arbitration rate, those at the data rate."""
    head = [0, *to_bits(identifier, 11), 0, 0, 1, 0, 1]
    body = [0, *to_bits(FD_LENGTHS.index(len(data)), 4), *(bit for byte in data for bit in to_bits(byte, 8))]
    dynamic = stuff([*head, *body])
    until_switch = len(stuff(head[:-1])) + 1
    field = [*to_bits(0b0110, 4), *to_bits(crc, 17 if len(data) <= 16 else 21)]
    fixed = [bit for i, data_bit in enumerate(field) for bit in ([1, data_bit] if i % 4 == 0 else [data_bit])]
    return until_switch + len(END), len(dynamic) - until_switch + len(fixed)


def most_stuffed(count: int) -> Bits:
    """Return the `count` bits that need most stuff bits: five equal bits, then groups of four opposite ones."""
    return [0] + [(i // 4) % 2 for i in range(count - 1)]
