"""Lanes: separate threads for each kind of request, so that a stop waits for no other request."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import TypeVar, TypeVarTuple

import anyio.to_thread
from anyio import CapacityLimiter

from rtloop.values import count_text

T = TypeVar("T")
Ts = TypeVarTuple("Ts")
RETRY_TEXT = "try again"


class TooManyRequests(Exception):
    """The lane of a request is full."""


class Lane(Enum):
    """Kind of request; the value is (number of threads, largest number of requests that run or wait)."""

    SAFETY = (4, 10_000)
    """Stop and reset; only the number of connections limits them."""
    BUILD = (1, 8)
    """Requests that build a law."""
    MEASUREMENT = (1, 1)
    """Requests that move a loop to measure it."""
    ORDINARY = (4, 32)


class Lanes:
    """Threads for the requests of each lane."""

    def __init__(self) -> None:
        """Begin with no request in any lane."""
        self._limiters = {lane: CapacityLimiter(lane.value[0]) for lane in Lane}
        self._pending_counts = dict.fromkeys(Lane, 0)

    async def run(self, lane: Lane, action: Callable[[*Ts], T], *arguments: *Ts) -> T:
        """Run `action` in a thread of the lane, once one is free, and return its result.

        Raises TooManyRequests, without a wait, if the lane's largest number of requests run or wait already, and the
        exceptions of the action.
        """
        limit = lane.value[1]
        if self._pending_counts[lane] >= limit:
            raise TooManyRequests(
                f"the service works on {count_text(limit, 'request')} of the kind {lane.name.lower()} already, and "
                f"accepts no more at a time; {RETRY_TEXT}"
            )
        self._pending_counts[lane] += 1
        try:
            return await anyio.to_thread.run_sync(action, *arguments, limiter=self._limiters[lane])
        finally:
            self._pending_counts[lane] -= 1
