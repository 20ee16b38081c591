"""A CAN bus that loses, doubles, delays and reorders received frames by a list; python-can's name for it is "faulty".

The bus is built on python-can's `virtual` interface. `deliveries[k]` has the delay in ticks of each copy of answer k
(from 0) to the loop: () loses the answer, (0,) is a good bus, (0, 2) doubles the answer, (1,) delivers it after its
successor. A tick ends when a receive call has returned no frame. The node gets frames of the loop at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import can
from can.interfaces.virtual import VirtualBus

can.interfaces.BACKENDS["faulty"] = (__name__, "FaultyBus")
can.VALID_INTERFACES = frozenset((*can.VALID_INTERFACES, "faulty"))
FIRST_SAMPLE, LAST_SAMPLE = 0x180, 0x184


class FaultyBus(VirtualBus):
    """The faulty bus. A test sets `deliveries` and `node`; without `deliveries` the bus has no faults."""

    deliveries: Sequence[Sequence[int]] | None = None
    node: Callable[[], None] = staticmethod(lambda: None)
    arrivals: list[list[int]]
    """Numbers of the answers handed over, tick by tick."""

    def __init__(self, channel: Any, **keywords: Any) -> None:
        super().__init__(channel, **keywords)
        self._tick, self._answers, self._waiting = 0, 0, []
        self.arrivals = [[]]

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        super().send(msg, timeout)
        self.node()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.deliveries is None:
            return super()._recv_internal(timeout)
        while (message := super()._recv_internal(0.0)[0]) is not None:
            if not FIRST_SAMPLE <= message.arbitration_id <= LAST_SAMPLE:
                continue
            for delay in self.deliveries[self._answers] if self._answers < len(self.deliveries) else (0,):
                self._waiting.append((self._tick + delay, message))
            self._answers += 1
        for item in sorted(self._waiting, key=lambda item: item[0]):
            if item[0] <= self._tick:
                self._waiting.remove(item)
                self.arrivals[-1].append(int.from_bytes(item[1].data[:2], "little"))
                return item[1], True
        self._tick += 1
        self.arrivals.append([])
        return None, True
