"""Sending and receiving of frames in compiled code: UDP datagrams, or COBS on a serial line."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import numpy as np

from rtloop.drivers.node.card import RAW_BYTES, ROOM_BYTES
from rtloop.foundation.native.compiled import c_library_function, jit, jit_rare
from rtloop.foundation.native.pointers import address_pointer, carray

MSG_DONTWAIT = 0x40
EMPTY, GONE, BROKEN = -3, -2, -1
"""Results in place of a frame's length: no bytes have come, a serial line has ended, bytes that are no frame."""
SKIPPING = -1
EINTR, EAGAIN = 4, 11
COBS_RUN = 254


def _library_call(
    name: str, result: type[ctypes._SimpleCData[int]], *types: type[ctypes._SimpleCData[int]]
) -> Callable[..., int]:
    """Return a Python function that calls the C library's function `name`, for kernels that run uncompiled.

    `result` and `types` are the ctypes types of its result and its arguments.
    """

    def call(*arguments: int) -> int:
        """Call the C function with integers and return its result."""
        function = getattr(ctypes.CDLL(None, use_errno=True), name)
        function.restype, function.argtypes = result, types
        return function(*map(int, arguments))

    return call


def _errno_address_in_python() -> int:
    """Copy the errno of the last call through `_library_call`; return the address of this copy, an int32."""
    _errno_copy.value = ctypes.get_errno()
    return ctypes.addressof(_errno_copy)


_errno_copy = ctypes.c_int32()


_INT, _WORD = ctypes.c_int32, ctypes.c_ssize_t
_send = c_library_function(
    "send", "intp(int32, intp, intp, int32)", _library_call("send", _WORD, _INT, _WORD, _WORD, _INT)
)
_recv = c_library_function(
    "recv", "intp(int32, intp, intp, int32)", _library_call("recv", _WORD, _INT, _WORD, _WORD, _INT)
)
_read = c_library_function("read", "intp(int32, intp, intp)", _library_call("read", _WORD, _INT, _WORD, _WORD))
_write = c_library_function("write", "intp(int32, intp, intp)", _library_call("write", _WORD, _INT, _WORD, _WORD))

_errno_address = c_library_function("__errno_location", "intp()", _errno_address_in_python)


@jit
def send_frame(card, length):
    """Send the first `length` bytes at `card.sent`; return whether the system took all of them."""
    if card.is_serial == 0:
        if _send(card.fd, card.sent, length, MSG_DONTWAIT) == length:
            return True
        # Linux may have reported that an earlier datagram was refused, which anybody can forge, in place of sending.
        return _send(card.fd, card.sent, length, MSG_DONTWAIT) == length
    coded_length = encode_cobs(card, length)
    return _write(card.fd, card.coded, coded_length) == coded_length


@jit
def receive_frame(card):
    """Copy the next frame to `card.received` and return its length; never wait.

    Returns EMPTY if no frame has come, BROKEN for bytes that are no frame, GONE if the serial line has ended.
    """
    if card.is_serial == 0:
        return _receive_datagram(card)
    return _receive_line(card)


@jit
def _receive_datagram(card):
    """Receive a datagram from the node; return its length as `receive_frame` does.

    EMPTY also for an error of the socket, BROKEN for a datagram that is longer than any frame.
    """
    length = _recv(card.fd, card.received, ROOM_BYTES, MSG_DONTWAIT)
    if length < 0 and carray(address_pointer(_errno_address()), 1, np.int32)[0] != EAGAIN:
        length = _recv(card.fd, card.received, ROOM_BYTES, MSG_DONTWAIT)  # The first call has cleared the error.
    if length < 0:
        return EMPTY
    return length if length < ROOM_BYTES else BROKEN


@jit_rare
def take_strangers(card, largest):
    """Receive, and discard, datagrams of senders other than the node at the loop's port; return their number.

    Takes at most `largest` datagrams. They overwrite the frame at `card.received`. Returns 0 on a serial line.
    """
    count = 0
    while count < largest and card.is_serial == 0:
        if _recv(card.strangers_fd, card.received, ROOM_BYTES, MSG_DONTWAIT) < 0:
            break
        count += 1
    return count


@jit_rare
def encode_cobs(card, length):
    """Encode the `length` bytes of the frame at `card.sent` in COBS, to `card.coded`, with the byte 0 at the end.

    Returns the encoded length. ROOM_BYTES suffice for every frame, and every frame has more than one byte.
    """
    plain = carray(address_pointer(card.sent), ROOM_BYTES, np.uint8)
    coded = carray(address_pointer(card.coded), ROOM_BYTES, np.uint8)
    head, position, run = 0, 1, 1
    for i in range(length):
        if plain[i] != 0:
            coded[position] = plain[i]
            position += 1
            run += 1
        if plain[i] == 0 or (run == COBS_RUN + 1 and i + 1 < length):
            coded[head] = run
            head, run = position, 1
            position += 1
    coded[head] = run
    coded[position] = 0
    return position + 1


@jit_rare
def _receive_line(card):
    """Decode the next whole frame of a serial line to `card.received`; return its length, EMPTY, BROKEN or GONE.

    The beginning of an incomplete frame waits for the rest: EMPTY. All bytes of a frame that is too long, up to the
    next byte 0, give one BROKEN. The serial line has ended: GONE.
    """
    raw = carray(address_pointer(card.raw), RAW_BYTES, np.uint8)
    partial = carray(address_pointer(card.partial), ROOM_BYTES, np.uint8)
    while True:
        if card.raw_position == card.raw_length:
            card.raw_position = 0
            count = _read(card.fd, card.raw, RAW_BYTES)
            card.raw_length = max(count, 0)
            if count <= 0:
                error = carray(address_pointer(_errno_address()), 1, np.int32)[0]
                return EMPTY if count < 0 and error in (EAGAIN, EINTR) else GONE
        while card.raw_position < card.raw_length:
            byte = raw[card.raw_position]
            card.raw_position += 1
            if byte != 0:
                if card.frame_length >= ROOM_BYTES:
                    card.frame_length = SKIPPING
                if card.frame_length != SKIPPING:
                    partial[card.frame_length] = byte
                    card.frame_length += 1
                continue
            length = card.frame_length
            card.frame_length = 0
            if length == SKIPPING:
                return BROKEN
            if length != 0:
                return decode_cobs(card, length)


@jit_rare
def decode_cobs(card, length):
    """Decode the `length` bytes at `card.partial`, without the byte 0 at the end, to `card.received`.

    Returns the frame's length, BROKEN if a run goes beyond the end.
    """
    partial = carray(address_pointer(card.partial), ROOM_BYTES, np.uint8)
    plain = carray(address_pointer(card.received), ROOM_BYTES, np.uint8)
    source, target = 0, 0
    while source < length:
        run = np.int64(partial[source])
        if source + run > length:
            return BROKEN
        for i in range(1, run):
            plain[target] = partial[source + i]
            target += 1
        source += run
        if run != COBS_RUN + 1 and source < length:
            plain[target] = 0
            target += 1
    return target
