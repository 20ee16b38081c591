"""Who waits for whom: requests that bring the outputs to rest have threads of their own and wait for no other."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Any

import anyio.to_thread
from anyio import CapacityLimiter

from rtloop.values import count_text

RETRY = "try again"


class Busy(Exception):
    """So many requests wait already."""


class Lane(Enum):
    """Requests of a kind: how many are worked on at a time, and how many may be there in all."""

    SAFETY = (4, 10_000)
    """Stop and reset: bounded by the number of connections alone."""
    BUILD = (1, 8)
    """What builds a law."""
    MEASUREMENT = (1, 1)
    """What moves a loop to measure it."""
    ORDINARY = (4, 32)


class Lanes:
    """Threads for the requests of each lane."""

    def __init__(self) -> None:
        self._limiters = {lane: CapacityLimiter(lane.value[0]) for lane in Lane}
        self._there = dict.fromkeys(Lane, 0)

    async def run(self, lane: Lane, action: Callable[..., Any], *arguments: Any) -> Any:
        """`action` in a thread, when it is its turn. Raises Busy, and what the action raises."""
        limit = lane.value[1]
        if self._there[lane] >= limit:
            raise Busy(f"{count_text(limit, 'request')} of this kind wait already; {RETRY}")
        self._there[lane] += 1
        try:
            return await anyio.to_thread.run_sync(action, *arguments, limiter=self._limiters[lane])
        finally:
            self._there[lane] -= 1
