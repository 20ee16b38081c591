"""The driver `serial` counts and reads exactly on a line that loses, doubles, damages and inserts bytes.

The oracle, `expected_counts`, is fed with the frames that the test parses from the bytes on the line.
"""

from __future__ import annotations

import array
import fcntl
import math
import os
import random
import select
import struct
import termios
import threading
import time
import tty
import zlib
from pathlib import Path

import pytest

from rtloop.drivers.base import Wiring
from rtloop.drivers.node.driver import SerialDriver
from rtloop.drivers.node.options import SerialOptions
from tests.drivers.node_bench import make_key
from tests.drivers.node_calls import open_calls
from tests.drivers.relay_frames import LOOP, Arrival
from tests.drivers.relayed_nodes import PythonNode
from tests.faults.evidence import wait_for
from tests.node.accounts import COUNTS, expected_counts
from tests.node.frames import SAMPLE, cobs, uncobs

pytestmark = pytest.mark.system

TICKS, PERIOD_US = 300, 1000
LONGEST_CODE = 2920
"""Length in bytes from which on the driver skips a frame on the line."""


class Line:
    """A pseudo-terminal with a node; a thread answers until `end_thread`, then the test by `exchange`."""

    def __init__(self, link: Path, key: str | None = None) -> None:
        self._fd, self._end = os.openpty()
        tty.setraw(self._end)
        link.symlink_to(os.ttyname(self._end))
        self.node, self._now_us, self._unfinished = PythonNode(key=key), 0, b""
        self._is_ended = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        """Answer all frames until the thread shall end."""
        while not self._is_ended.is_set():
            for answer in self._answers(0.01):
                os.write(self._fd, cobs(answer))

    def end_thread(self) -> None:
        """End the thread that answers."""
        self._is_ended.set()
        self._thread.join()

    def serve_again(self) -> None:
        """Start a thread that answers again."""
        self._is_ended.clear()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _answers(self, timeout_s: float) -> list[bytes]:
        """Return the node's answers to the complete frames that have arrived."""
        if not select.select([self._fd], [], [], timeout_s)[0]:
            return []
        *frames, self._unfinished = (self._unfinished + os.read(self._fd, 65_536)).split(b"\0")
        self._now_us += PERIOD_US
        answers = [self.node.receive(uncobs(frame), LOOP, self._now_us) for frame in frames if frame]
        return [answer for answer in answers if answer]

    def exchange(self, damage: random.Random, fd: int) -> bytes:
        """Answer a drive with randomly damaged bytes; return the bytes once all have reached the driver's end."""
        answers: list[bytes] = []
        while not answers:
            answers = self._answers(60.0)
        sent = b"".join(damage_half(cobs(answer), damage) for answer in answers)
        os.write(self._fd, sent)
        waiting = array.array("i", [0])

        def have_arrived() -> bool:
            fcntl.ioctl(fd, termios.FIONREAD, waiting)
            return waiting[0] == len(sent)

        wait_for(have_arrived, "the bytes", poll_s=0.0)
        return sent

    def close(self) -> None:
        """End the thread and close the line."""
        self.end_thread()
        os.close(self._fd)
        os.close(self._end)


def damage_half(line: bytes, chance: random.Random) -> bytes:
    """Return the bytes of a frame; every second one, on average, is damaged."""
    place = chance.randrange(len(line))
    return {
        0: lambda: b"",
        1: lambda: line + line,
        2: lambda: line[:place] + line[place + 1 :],  # a byte is lost, at times the end of the frame
        3: lambda: line[:place] + bytes([line[place] ^ 1 << chance.randrange(8)]) + line[place + 1 :],
        4: lambda: chance.randbytes(20) + b"\0" + line,
        5: lambda: bytes(3) + line,
        6: lambda: line[:place] + b"\0" + line[place:],
    }.get(chance.randrange(14), lambda: line)()


def parse_arrivals(stream: list[bytes], boot: int, session: int) -> list[list[Arrival]]:
    """Return, for each tick, the arrivals of the frames that end in its bytes."""
    ticks, unfinished = [], b""
    for data in stream:
        *lines, unfinished = (unfinished + data).split(b"\0")
        ticks.append([parse_arrival(line, boot, session) for line in lines if line])
    return ticks


def parse_arrival(line: bytes, boot: int, session: int) -> Arrival:
    """Return the arrival of the bytes between two bytes 0: a sample or an invalid frame."""
    try:
        content = uncobs(line) if len(line) < LONGEST_CODE else b""
    except ValueError:
        content = b""
    if len(content) != 44 or content[2] != SAMPLE or struct.unpack("<I", content[-4:])[0] != zlib.crc32(content[:-4]):
        return Arrival("invalid")
    sequence, *owner, code = struct.unpack("<4xIII12xi12x", content)
    assert owner == [session, boot]
    return Arrival("sample", sequence, (code,))


@pytest.mark.parametrize(("seed", "has_key"), [(1, False), (2, False), (3, True)])
def test_the_counts_are_what_the_line_did(seed, has_key, tmp_path):
    key = make_key(tmp_path) if has_key else None
    line, chance = Line(tmp_path / "tty", key), random.Random(seed)
    options = SerialOptions(
        device=str(tmp_path / "tty"), key=key, hold_ticks=2, error_limit=1_000_000, watchdog_ms=5000, wait_s=60
    )
    driver = SerialDriver(options, {"x": Wiring("adc0", "dac0")}, 100.0)
    calls = open_calls(driver)
    calls.read()
    line.end_thread()
    card = driver._opened_card
    first, results, stream = int(card["sequence"][0]), [], []
    start_s = time.monotonic()
    for tick in range(TICKS):
        results.append(calls.read())
        volts = 5.0 * math.sin(0.7 * tick)
        assert calls.write([volts]) == 0
        stream.append(line.exchange(chance, int(card["fd"][0])))
        assert line.node.volts(line.node.outputs[0]) == pytest.approx(volts, abs=1e-5)
        assert time.monotonic() < start_s + 120
    boot, session = int(card["boot"][0]), int(card["session"][0])
    line.serve_again()
    driver.close()
    line.close()
    arrivals = [[Arrival("sample", first)], *parse_arrivals(stream, boot, session)[: TICKS - 1]]
    expected, counted = expected_counts(arrivals, first), [values[2 : 2 + len(COUNTS)] for _, values in results]
    assert counted == expected
    assert expected[-1][0] > 0 < expected[-1][2]
    newest, reading = first, 0.0
    for arrived, (_, values) in zip(arrivals, results, strict=True):
        for sample in arrived:
            if sample.kind == "sample" and sample.sequence > newest:
                newest, reading = sample.sequence, line.node.volts(sample.codes[0])
        assert newest == first or values[0] == pytest.approx(reading, abs=1e-8)
