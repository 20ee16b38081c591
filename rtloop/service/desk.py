"""The desk where commands for the loop are handed in, each answered by the event that it became.

Callers do not wait for each other. A command that is not answered in time is withdrawn: it took effect, or it was
refused, and never both.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

import numpy as np

from rtloop.engine.commands import send, withdraw
from rtloop.engine.memory import SharedBlock
from rtloop.engine.messages import ALL_AXES, MESSAGE, Kind, Origin, message
from rtloop.engine.ring import drain
from rtloop.errors import RtloopError
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.recording.file.topics.events import OPERATOR
from rtloop.signals import Mode

ANSWER_TIMEOUT_S = 2.0
ANSWER_PERIODS = 3.0
"""A loop that is slower than ANSWER_TIMEOUT_S has so many periods to answer."""
POLL_S = 0.001
MOST_CHANGES = 1000
"""Changes of a law that are remembered in words."""


@dataclass(frozen=True)
class Asker:
    """Who asks: the name and the origin that the recording shows; `require` raises Refused for who may no longer."""

    name: str = OPERATOR
    origin: Origin = Origin.OPERATOR
    require: Callable[[], None] = lambda: None


NOBODY = Asker()
"""Who gives no name."""
_asker = ContextVar("asker", default=NOBODY)


@contextmanager
def asked_by(asker: Asker) -> Iterator[None]:
    """What this thread asks for in between, and those that it hands its context to, is asked for by `asker`."""
    token = _asker.set(asker)
    try:
        yield
    finally:
        _asker.reset(token)


class Refused(RtloopError):
    """The loop did not take a command, or not in time."""


class Taken(RtloopError):
    """The loop took a command and stands still: nobody knows its tick."""


class Desk:
    """Commands to the loop of `block`, from any thread; the recorder finds who asked in `names`."""

    def __init__(self, block: SharedBlock, rate_hz: float = 1e6, names: RequesterNames | None = None) -> None:
        self._block, self._period_s, self._names = block, 1.0 / rate_hz, names
        self._lock = threading.Lock()
        self._identity = 0
        self._changes: OrderedDict[int, str] = OrderedDict()

    def change_of(self, identity: int) -> str | None:
        """The change that a command made, in words; None where none was given, or MOST_CHANGES came after it."""
        return self._changes.get(identity)

    def submit(
        self, kind: Kind, *, axis: int = ALL_AXES, values: Sequence[float] = (), change: str | None = None
    ) -> int:
        """Send a command and wait until its tick was executed, which it returns; `change` says in words what it
        changes. Raises Refused, Taken, QueueFull.
        """
        requester = _asker.get()
        command = message(kind, axis=axis, origin=requester.origin, values=values)
        is_urgent = kind is Kind.RESET_TRIP or (kind is Kind.SET_MODE and values[0] == Mode.OFF)
        if not is_urgent:
            requester.require()
        with self._lock:  # the queue has one producer
            self._identity += 1
            command["identity"] = identity = self._identity
            cursor = int(self._block["events_head"][0])
            if self._names is not None and requester.name != OPERATOR:
                self._names.store(identity, requester.name)
            if change is not None:
                self._changes[identity] = change
                if len(self._changes) > MOST_CHANGES:
                    self._changes.popitem(last=False)
            position = send(self._block, command, urgent=is_urgent)
        return self._answer(kind, identity, cursor, position)

    def _answer(self, kind: Kind, identity: int, cursor: int, position: int) -> int:
        timeout_s = ANSWER_TIMEOUT_S + ANSWER_PERIODS * self._period_s
        ring, deadline = self._block.ring("events"), time.monotonic() + timeout_s
        events: np.ndarray[Any, Any] = np.zeros(64, MESSAGE)
        while time.monotonic() < deadline:
            event_count, first, _ = drain(ring, cursor, events)
            cursor = int(first) + event_count
            for event in events[:event_count]:
                if event["identity"] == identity:
                    if event["kind"] == Kind.REFUSED:
                        raise Refused(f"{kind.name.lower()}: refused at tick {event['tick']}: tripped or stopping")
                    self._await_tick(int(event["tick"]), deadline)
                    return int(event["tick"])
            time.sleep(POLL_S)
        if withdraw(self._block, position):
            raise Refused(f"{kind.name.lower()}: the loop did not answer within {timeout_s:g} s; withdrawn")
        raise Taken(f"{kind.name.lower()}: the loop has taken it and stands still; it takes effect if the loop goes on")

    def _await_tick(self, tick: int, deadline: float) -> None:
        """The event comes before its tick: what is read off the newest record is to show the command's effect."""
        while int(self._block["ticks_head"][0]) <= tick and time.monotonic() < deadline:
            time.sleep(POLL_S)
