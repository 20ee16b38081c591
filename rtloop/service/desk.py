"""The desk where commands for the loop are handed in: one at a time, each answered by the event that it became."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextvars import ContextVar
from typing import Any

import numpy as np

from rtloop.engine.commands import send
from rtloop.engine.memory import SharedBlock
from rtloop.engine.messages import ALL_AXES, MESSAGE, Kind, Origin, message
from rtloop.engine.ring import drain
from rtloop.errors import RtloopError

ANSWER_TIMEOUT_S = 2.0
POLL_S = 0.001
asked_by = ContextVar("asked_by", default=Origin.OPERATOR)
"""Who asks, in this thread: the origin that the recording shows."""


class Refused(RtloopError):
    """The loop did not take a command, or not in time."""


class Desk:
    """Commands to the loop of `block`. The queue has one producer, so callers take turns."""

    def __init__(self, block: SharedBlock) -> None:
        self._block = block
        self._lock = threading.Lock()
        self._identity = 0

    def submit(self, kind: Kind, *, axis: int = ALL_AXES, values: Sequence[float] = ()) -> int:
        """Send a command and wait until its tick was executed, which it returns. Raises Refused."""
        with self._lock:
            self._identity += 1
            command = message(kind, axis=axis, origin=asked_by.get(), values=values)
            command["identity"] = self._identity
            cursor = int(self._block["events_head"][0])
            send(self._block, command)
            return self._answer(kind, cursor)

    def _answer(self, kind: Kind, cursor: int) -> int:
        ring, deadline = self._block.ring("events"), time.monotonic() + ANSWER_TIMEOUT_S
        events: np.ndarray[Any, Any] = np.zeros(64, MESSAGE)
        while time.monotonic() < deadline:
            copied, first, _ = drain(ring, np.uint64(cursor), events)
            cursor = int(first) + copied
            for event in events[:copied]:
                if event["identity"] == self._identity:
                    if event["kind"] == Kind.REFUSED:
                        raise Refused(f"{kind.name.lower()}: refused at tick {event['tick']}: tripped or stopping")
                    self._await_tick(int(event["tick"]), deadline)
                    return int(event["tick"])
            time.sleep(POLL_S)
        raise Refused(f"{kind.name.lower()}: the loop did not answer within {ANSWER_TIMEOUT_S:g} s")

    def _await_tick(self, tick: int, deadline: float) -> None:
        """The event comes before its tick: what is read off the newest record is to show the command's effect."""
        while int(self._block["ticks_head"][0]) <= tick and time.monotonic() < deadline:
            time.sleep(POLL_S)
