"""The two nodes behind a relay: the simulated node, and the C library on a simulated board."""

from __future__ import annotations

import ctypes

from rtloop.drivers.node.keys import read_key
from rtloop.drivers.node.options import UdpOptions
from rtloop.drivers.node.simulated import SimulatedNode
from tests.drivers.relay_frames import LOOP
from tests.node.bench import Bench
from tests.node.frames import Channel

LARGEST_CODE = 2**23 - 1
RAMP_CODES = 2**20
LONG_HOLD_US = 10_000_000


class CountingNode(SimulatedNode):
    """The simulated node with an input whose code is the number of readings."""

    readings = 0

    def _read_inputs(self) -> list[int]:
        self.readings += 1
        return [self.readings]


class PythonNode:
    """The simulated node with one input and one output; its plant stands still."""

    def __init__(self, boot: int | None = None, key: str | None = None) -> None:
        self.key = key
        self._node = CountingNode(UdpOptions(park_slew_v_per_s=1e5), ["x"], boot, read_key(key))
        self._node._rig.advance_to = lambda elapsed_s: None

    def receive(self, data: bytes, sender: str, now_us: int) -> bytes:
        """Process a datagram at a time; return the answer, or no bytes."""
        return self._node.receive(data, sender, now_us) or b""

    @property
    def outputs(self) -> tuple[int, ...]:
        """Present codes of the outputs."""
        return tuple(self._node.codes)

    def volts(self, code: int) -> float:
        """Return the voltage of an output code."""
        return self._node._outputs[0].volts(code)

    @property
    def counts(self) -> tuple[int, int]:
        """Number of invalid frames, and of parkings by the watchdog."""
        return self._node.invalid, self._node.watchdog_parkings


class LibraryNode:
    """The library in deploy/node with one input, whose codes count the datagrams, and one output."""

    def __init__(self, library: ctypes.CDLL, boot: int = 1, key: str | None = None) -> None:
        self.key = key
        self._bench, self._samples = Bench(library), 0
        volts = 10 / LARGEST_CODE
        source, sink = (Channel(-LARGEST_CODE, LARGEST_CODE, 0, ramp, volts, 0.0) for ramp in (0, RAMP_CODES))
        assert self._bench.start([source], [sink], (0, 0), LONG_HOLD_US, boot, read_key(key))

    def receive(self, data: bytes, sender: str, now_us: int) -> bytes:
        """Process a datagram at a time; return the answer, or no bytes."""
        self._samples += 1
        self._bench.set_inputs([self._samples % LARGEST_CODE])
        self._bench.now_us = now_us
        self._bench.poll()
        return self._bench.send_bytes(data, 1 if sender == LOOP else 2)

    @property
    def outputs(self) -> tuple[int, ...]:
        """Present codes of the outputs."""
        return tuple(self._bench.codes)

    def volts(self, code: int) -> float:
        """Return the voltage of an output code."""
        return code * 10 / LARGEST_CODE

    @property
    def counts(self) -> tuple[int, int]:
        """Number of invalid frames, and of parkings by the watchdog."""
        return self._bench.counters.invalid, self._bench.counters.watchdog_trips
