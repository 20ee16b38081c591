"""Random bytes for the compiled exchange, run as plain Python, where an index outside an array raises an error.

    NUMBA_DISABLE_JIT=1 python -m tests.drivers.node_fuzz KIND SEED COUNT

prints the counters as JSON. KIND is "udp", "udp with a key" or "serial".
"""

from __future__ import annotations

import json
import os
import random
import socket
import struct
import sys
import zlib

import numpy as np

from rtloop.drivers.node import tags
from rtloop.drivers.node.card import COUNTS, OBSERVED, make_card
from rtloop.drivers.node.cobs import encode
from rtloop.drivers.node.exchange import node_read, node_write
from rtloop.drivers.node.frames import Scale
from tests.node import frames

SESSION, BOOT, INPUTS = 77, 88, 3
SCALES = (Scale(-1000, 1000, 0, 1, 0.01, 0.0),) * INPUTS


def sample(sequence: int, codes: list[int], seal: tags.Seal) -> bytes:
    """Return the bytes of a SAMPLE, written from docs/node-protocol.md."""
    content = struct.pack(f"<IIBBHII{len(codes)}i", SESSION, BOOT, 1, len(codes), 0, 0, 0, *codes)
    return frames.frame(frames.SAMPLE, sequence, content, frames.Seal(*seal))


def damage(frame: bytes, draw: random.Random, seal: tags.Seal) -> bytes:
    """Return a damaged frame: a changed bit, cut, grown, random bytes, or one changed byte with a right tag and CRC."""
    kind = draw.randrange(5)
    if kind == 0:
        place = draw.randrange(len(frame))
        return frame[:place] + bytes([frame[place] ^ 1 << draw.randrange(8)]) + frame[place + 1 :]
    if kind == 1:
        return frame[: draw.randrange(len(frame))]
    if kind == 2:
        return frame + draw.randbytes(draw.randrange(1, 5000))
    if kind == 3:
        return draw.randbytes(draw.randrange(1, 6000))
    head = bytearray(frame[:-12])
    head[draw.randrange(8, 24)] = draw.randrange(256)
    content = bytes(head) + struct.pack("<Q", frames.Seal(*seal).tag(bytes(head)))
    return content + struct.pack("<I", zlib.crc32(content))


def fuzz(kind: str, seed: int, count: int) -> dict[str, float]:
    """Send `count` frames, half of them damaged, each before a read; return the counters at the end.

    Raises IndexError for an index outside an array, AssertionError for codes that no valid frame had.
    """
    draw = random.Random(seed)
    seal = tags.Seal(bytes(range(16)) if "key" in kind else None, BOOT, 1)
    if kind.startswith("udp"):
        loop, node, strangers = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(3))
        for endpoint in (loop, node, strangers):
            endpoint.bind(("127.0.0.1", 0))
            endpoint.setblocking(False)
        loop.connect(node.getsockname())
        fd, strangers_fd = loop.fileno(), strangers.fileno()
        send = lambda data: node.sendto(data, loop.getsockname())
    else:
        incoming, outgoing = os.pipe()
        os.set_blocking(incoming, False)
        fd, strangers_fd = incoming, None
        send = lambda data: os.write(outgoing, data if draw.random() < 0.1 else encode(data))
    card, arrays = make_card(
        fd, strangers_fd, seal, in_scales=SCALES, out_scales=SCALES, hold_ticks=1000,
        error_limit=1 << 40, session=SESSION, hold_us=1000, running=1,
    )  # fmt: skip
    values, volts = np.zeros(INPUTS + 1 + len(OBSERVED)), np.zeros(INPUTS)
    allowed_codes: set[tuple[int, ...]] = {(0, 0, 0)}
    for _ in range(count):
        node_write(card.ctypes.data, volts.ctypes.data)
        sequence = int(card["sequence"][0]) - draw.choice((0, 0, 0, 1, 2, 3000)) & 0xFFFFFFFF
        codes = [draw.randint(-1100, 1100) for _ in range(INPUTS)]
        frame = sample(sequence, codes, seal)
        if draw.random() < 0.5:
            frame = damage(frame, draw, seal)
        if frame[-4:] == struct.pack("<I", zlib.crc32(frame[:-4])) and max(map(abs, codes)) <= 1000:
            allowed_codes.add(tuple(codes))
        send(frame)
        node_read(card.ctypes.data, values.ctypes.data)
        card["failure"] = 0
        assert tuple(arrays["codes"].tolist()) in allowed_codes, arrays["codes"]
    return {name: int(card[name][0]) for name in COUNTS}


if __name__ == "__main__":
    print(json.dumps(fuzz(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))))
