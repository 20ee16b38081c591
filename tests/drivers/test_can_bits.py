"""Lengths and highest rates of CAN frames, compared with frames built bit by bit and with figures of the literature."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtloop.drivers.can.bits import FD_LENGTHS, classic_frame_bits, fd_frame_bits
from rtloop.drivers.can.frames import DBC, choose_exchange, load_frames
from rtloop.drivers.can.options import BusOptions
from tests.drivers import can_oracle as oracle

STUFFED_BYTES = st.sampled_from([0x00, 0xFF, 0x0F, 0xF0, 0x1E, 0xE1, 0x3C, 0xC3, 0x78, 0x87, 0x07, 0xF8])
IDENTIFIERS = st.integers(0, 0x7FF) | st.sampled_from([0x000, 0x078, 0x087, 0x0F0, 0x1E1, 0x7FF])


def data_bytes(length: int) -> st.SearchStrategy[bytes]:
    """Return a strategy for `length` bytes, among which bytes that need many stuff bits are frequent."""
    return st.lists(STUFFED_BYTES | st.integers(0, 255), min_size=length, max_size=length).map(bytes)


@pytest.mark.parametrize("length", range(9))
def test_the_worst_stream_reaches_the_classic_bound(length):
    sent = oracle.stuff(oracle.most_stuffed(34 + 8 * length))
    assert len(sent) + len(oracle.END) == classic_frame_bits(length)


def test_classic_lengths_of_the_literature():
    """Davis, Burns, Bril, Lukkien (2007): 55 + 10n bits with an 11-bit identifier."""
    assert [classic_frame_bits(length) for length in range(9)] == [55, 65, 75, 85, 95, 105, 115, 125, 135]


@settings(max_examples=300)
@given(IDENTIFIERS, st.integers(0, 8).flatmap(data_bytes))
def test_no_classic_frame_is_longer(identifier, data):
    assert len(oracle.classic_frame(identifier, data)) <= classic_frame_bits(len(data))


@settings(max_examples=300)
@given(IDENTIFIERS, st.sampled_from(oracle.FD_LENGTHS).flatmap(data_bytes))
def test_no_fd_frame_is_longer(identifier, data):
    slow, fast = oracle.fd_frame_lengths(identifier, data)
    most_slow, most_fast = fd_frame_bits(len(data))
    assert slow <= most_slow
    assert slow + fast <= most_slow + most_fast
    for data_rate in (1.0, 2.0, 5.0, 8.0):
        assert slow + fast / data_rate <= most_slow + most_fast / data_rate


@pytest.mark.parametrize("length", FD_LENGTHS)
def test_the_worst_stream_reaches_the_fd_bound_in_all(length):
    stuff = len(oracle.stuff(oracle.most_stuffed(22 + 8 * length))) - (22 + 8 * length)
    slow, fast = oracle.fd_frame_lengths(0x555, bytes(length))
    unstuffed = slow + fast - (len(_stuffed_part(length)) - (22 + 8 * length))
    assert sum(fd_frame_bits(length)) == unstuffed + stuff


def _stuffed_part(length: int) -> list[int]:
    """Return identifier 0x555, control field and `length` zero bytes of a CAN FD frame, with their stuff bits."""
    code = oracle.to_bits(oracle.FD_LENGTHS.index(length), 4)
    head = [0, *oracle.to_bits(0x555, 11), 0, 0, 1, 0, 1, 0, *code]
    return oracle.stuff([*head, *[0] * (8 * length)])


def fd_frame_s(length: int, data_bitrate: float) -> float:
    """Return the time in s of a CAN FD frame of `length` bytes at 1 Mbit/s and `data_bitrate` in the worst case.

    34 slow bits, then fast ones: 5 + 8n, a CRC field of 27 or 32, and the stuff bits that are not slow.
    """
    return 34e-6 + (5 + 8 * length + (27 if length <= 16 else 32) + (21 + 8 * length) // 4 - 4) / data_bitrate


@pytest.mark.parametrize(
    ("options", "channels", "rate_hz"),
    [
        (BusOptions(), 1, 1e6 / (95 + 115)),
        (BusOptions(), 2, 1e6 / (115 + 135)),
        (BusOptions(bitrate=500_000), 1, 5e5 / (95 + 115)),
        (BusOptions(fd=True, data_bitrate=5_000_000), 1, 1 / (fd_frame_s(4, 5e6) + fd_frame_s(6, 5e6))),
        (BusOptions(fd=True, data_bitrate=5_000_000), 2, 1 / (fd_frame_s(6, 5e6) + fd_frame_s(8, 5e6))),
        (BusOptions(fd=True, data_bitrate=8_000_000), 3, 1 / (2 * fd_frame_s(20, 8e6))),
    ],
)
def test_the_highest_rate(options, channels, rate_hz):
    pair = choose_exchange(load_frames(options), channels, options)
    assert pair.max_rate_hz(options) == pytest.approx(rate_hz, rel=1e-12)


def test_a_drive_frame_without_its_sample_frame_is_left_out():
    frames = {name: frame for name, frame in load_frames(BusOptions()).items() if name.startswith("Drive")}
    with pytest.raises(ValueError, match="channels: 1 axes; the DBC file has no pair of classic CAN frames"):
        choose_exchange(frames, 1, BusOptions())


def test_there_is_one_dbc():
    frames = load_frames(BusOptions())
    assert DBC.resolve() == Path(__file__).resolve().parents[2] / "deploy" / "rtloop.dbc"
    assert len({frame.identifier for frame in frames.values()}) == len(frames)
