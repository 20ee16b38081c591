"""Duration of a frame on the wire: bits with the worst stuffing, 11-bit identifiers, space between frames included.

Classic (ISO 11898-1), n bytes: 34 + 8n bits from the start of the frame to the end of its CRC can be stuffed. The worst
stream needs a stuff bit after five equal bits and then after every four alternating ones. 13 more bits are not stuffed.

    8n + 44 + 3 + ⌊(34 + 8n − 1) / 4⌋

CAN FD, n bytes: 17 bits up to the rate switch, and 5 + 8n after it (ESI, length, data), can be stuffed.
The CRC field has fixed stuff bits instead, before its first bit and after every four: 17 + 4 + 6 bits up to 16 bytes,
21 + 4 + 7 above. CRC delimiter, acknowledgement, its delimiter, end of frame and space are 13 slow bits.
"""

from __future__ import annotations

FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
_CLASSIC_STUFFED, _CLASSIC_UNSTUFFED = 34, 13
_FD_SLOW, _FD_HEAD, _FD_TAIL = 17, 5, 13
_SHORT_CRC_BYTES, _SHORT_CRC_FIELD, _LONG_CRC_FIELD = 16, 17 + 4 + 6, 21 + 4 + 7


def max_stuff_bits(bits: int) -> int:
    """Return the largest number of stuff bits that CAN can add to `bits` successive bits."""
    return (bits - 1) // 4


def classic_frame_bits(length: int) -> int:
    """Return the largest number of bits on the wire of a classic frame with `length` data bytes.

    The frame has an 11-bit identifier; the 3 bits of space after it count.
    """
    stuffable_bits = _CLASSIC_STUFFED + 8 * length
    return stuffable_bits + max_stuff_bits(stuffable_bits) + _CLASSIC_UNSTUFFED


def fd_frame_bits(length: int) -> tuple[int, int]:
    """Return the largest numbers of bits (slow, fast) of a CAN FD frame with 11-bit identifier and `length` data bytes.

    `length` is one of FD_LENGTHS. Slow bits have the bitrate of the arbitration phase, fast bits that of the data
    phase. As many stuff bits as possible are counted as slow.
    """
    stuffable_bits = _FD_SLOW + _FD_HEAD + 8 * length
    slow_stuff = max_stuff_bits(_FD_SLOW)
    crc = _SHORT_CRC_FIELD if length <= _SHORT_CRC_BYTES else _LONG_CRC_FIELD
    fast = _FD_HEAD + 8 * length + max_stuff_bits(stuffable_bits) - slow_stuff + crc
    return _FD_SLOW + slow_stuff + _FD_TAIL, fast


def frame_duration_s(length: int, fd: bool, bitrate: int, data_bitrate: int) -> float:
    """Return the longest duration in s of a frame with `length` data bytes: classic, or CAN FD if `fd`.

    The rates are in bit/s; `data_bitrate` counts for CAN FD alone.
    """
    if not fd:
        return classic_frame_bits(length) / bitrate
    slow, fast = fd_frame_bits(length)
    return slow / bitrate + fast / data_bitrate
