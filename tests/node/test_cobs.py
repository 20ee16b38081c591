"""Coding of frames on a serial line, compared with a coder in Python, and decoding after every kind of damage."""

from __future__ import annotations

import ctypes
import random
from collections.abc import Iterator

import pytest

from tests.node.frames import cobs, uncobs

LONGEST = 36 + 4 * 255


class Line:
    """The library's receiver at the end of a serial line."""

    def __init__(self, library: ctypes.CDLL):
        self.library = library
        self.receiver = ctypes.c_void_p(library.cobs_new())
        self.buffer = ctypes.create_string_buffer(LONGEST)

    def feed(self, line: bytes) -> list[bytes]:
        """Give the receiver bytes, and return the frames that they complete."""
        lengths = ((self.library.cobs_receive(self.receiver, ctypes.c_uint8(byte), self.buffer)) for byte in line)
        return [self.buffer.raw[:length] for length in lengths if length]

    @property
    def damaged(self) -> int:
        """Number of damaged frames."""
        return self.library.cobs_damaged(self.receiver)


@pytest.fixture
def line(library: ctypes.CDLL) -> Iterator[Line]:
    """Yield a new receiver of the library."""
    line = Line(library)
    yield line
    library.cobs_delete(line.receiver)


def encode(library: ctypes.CDLL, content: bytes) -> bytes:
    """Return a frame coded by the library; require that the coder writes within its documented memory."""
    size = len(content) + len(content) // 254 + 2
    memory = ctypes.create_string_buffer(b"\xaa" * (size + 8), size + 8)
    length = library.cobs_encode(content, ctypes.c_size_t(len(content)), memory)
    assert memory.raw[size:] == b"\xaa" * 8
    return memory.raw[:length]


def sample_frames() -> list[bytes]:
    """Return frames with few and many zeros, of lengths around the ends of blocks."""
    numbers = random.Random(3)
    lengths = [*range(1, 12), 20, 36, 252, 253, 254, 255, 256, 507, 508, 509, 510, 762, 1047, 1048]
    full = [bytes([1]) * length for length in lengths]
    empty = [bytes(length) for length in lengths]
    mixed = [bytes(numbers.choices(range(256), [share, *[1] * 255], k=n)) for n in lengths for share in (0, 1, 200)]
    ends = [bytes([7]) * n + b"\0" + bytes([8]) * m for n in (0, 253, 254, 255) for m in (0, 1, 253, 254, 255)]
    return full + empty + mixed + ends


@pytest.mark.parametrize(
    ("content", "coded"),
    [  # the examples of Cheshire and Baker, and the ends of a block
        (b"\0", b"\1\1\0"),
        (b"\0\0", b"\1\1\1\0"),
        (b"\x11\x22\0\x33", b"\3\x11\x22\2\x33\0"),
        (b"\x11\0\0\0", b"\2\x11\1\1\1\0"),
        (bytes(range(1, 255)), b"\xff" + bytes(range(1, 255)) + b"\0"),
        (bytes(range(255)), b"\1\xff" + bytes(range(1, 255)) + b"\0"),
        (bytes(range(1, 256)), b"\xff" + bytes(range(1, 255)) + b"\2\xff\0"),
        (bytes(range(2, 256)) + b"\0", b"\xff" + bytes(range(2, 256)) + b"\1\1\0"),
    ],
)
def test_known_frames_are_coded_as_printed(library: ctypes.CDLL, content: bytes, coded: bytes):
    assert encode(library, content) == cobs(content) == coded


def test_the_coder_agrees_with_python(library: ctypes.CDLL):
    for content in sample_frames():
        coded = encode(library, content)
        assert coded == cobs(content)
        assert uncobs(coded[:-1]) == content
        assert 0 not in coded[:-1]


def test_the_receiver_returns_what_was_sent(line: Line):
    frames = sample_frames()
    assert line.feed(b"".join(map(cobs, frames))) == frames
    assert line.damaged == 0


def test_a_block_of_254_bytes_may_end_with_an_empty_one(line: Line):
    assert line.feed(b"\xff" + bytes([1]) * 254 + b"\1\0") == [bytes([1]) * 254]


def test_the_receiver_finds_the_next_frame_after_garbage(line: Line):
    numbers = random.Random(4)
    for _ in range(200):
        line.feed(numbers.randbytes(numbers.randrange(3000)) + b"\0")
        assert line.feed(cobs(b"good")) == [b"good"]


def test_a_frame_that_was_cut_is_dropped_and_the_next_one_is_not(line: Line):
    coded = cobs(b"abcdefgh\0ijkl")
    for length in range(1, len(coded) - 1):
        frames = line.feed(coded[:length] + b"\0")
        assert len(frames) == (length == 9)  # cut between two blocks, where the check finds it
        assert line.feed(cobs(b"good")) == [b"good"]
    assert line.damaged == len(coded) - 3


def test_a_frame_longer_than_any_is_dropped(line: Line):
    assert line.feed(cobs(bytes([5]) * LONGEST)) == [bytes([5]) * LONGEST]
    for content in (bytes([5]) * (LONGEST + 1), bytes(100_000), bytes([5]) * 100_000):
        assert line.feed(cobs(content)) == []
        assert line.feed(cobs(b"good")) == [b"good"]
    assert line.damaged == 3


def test_bytes_0_alone_are_no_frames(line: Line):
    assert line.feed(bytes(1000)) == []
    assert line.damaged == 0
    assert line.feed(cobs(b"good")) == [b"good"]
