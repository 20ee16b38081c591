"""COBS: frames on a serial line, without the byte 0 inside and with it at the end (Cheshire and Baker 1999)."""

from __future__ import annotations

LONGEST_RUN = 254
LONGEST_CODE = 4096
"""Bytes without an end after which a reader waits for the next frame."""


def encode(frame: bytes) -> bytes:
    """Return `frame` in COBS, with the byte 0 as its end."""
    coded = bytearray()
    for part in frame.split(b"\0"):
        while len(part) >= LONGEST_RUN:
            coded += bytes([LONGEST_RUN + 1]) + part[:LONGEST_RUN]
            part = part[LONGEST_RUN:]
        coded += bytes([len(part) + 1]) + part
    return bytes(coded) + b"\0"


def decode(code: bytes) -> bytes | None:
    """Return the frame that `code` encodes, COBS without the byte 0 at its end.

    None if `code` is malformed: a byte 0 begins a run, or a run goes beyond the end.
    """
    frame, position = bytearray(), 0
    while position < len(code):
        run = code[position]
        part = code[position + 1 : position + run]
        if run == 0 or len(part) != run - 1:
            return None
        frame += part
        position += run
        if run <= LONGEST_RUN and position < len(code):
            frame.append(0)
    return bytes(frame)


class FrameReader:
    """Takes bytes as they come and returns whole frames; bytes that are no frame are counted in `broken`."""

    def __init__(self) -> None:
        """Begin without bytes; `broken` is 0."""
        self._bytes, self.broken, self._skips = bytearray(), 0, False

    def feed(self, data: bytes) -> None:
        """Add received bytes, which `next_frame` decodes.

        If more than LONGEST_CODE bytes have no byte 0, `next_frame` discards them and all up to the next byte 0.
        """
        self._bytes += data

    def next_frame(self) -> bytes | None:
        """Return the next whole frame, decoded; None if no further one is complete.

        Malformed frames before it are left out and counted in `broken`.
        """
        while (end := self._bytes.find(0)) >= 0:
            code = bytes(self._bytes[:end])
            del self._bytes[: end + 1]
            frame = decode(code) if code and not self._skips else None
            self.broken += frame is None and bool(code)
            self._skips = False
            if frame:
                return frame
        if len(self._bytes) > LONGEST_CODE:
            self._bytes.clear()
            self._skips = True
        return None
