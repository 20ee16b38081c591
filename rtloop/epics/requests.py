"""Requests of EPICS clients to the service: one after another, except that a stop waits for no other request."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from rtloop.errors import LoopFault

MAX_PENDING = 32
"""Largest number of requests that wait or run, as in the service."""
STOP_THREADS = 4


class Requests:
    """Executes requests in threads, so that a slow service delays neither the channels nor a stop.

    A stop withdraws all requests that came before it and have not begun.
    """

    def __init__(self) -> None:
        """Begin without requests: one thread for ordinary ones, STOP_THREADS for stops."""
        self._ordinary, self._stops = ThreadPoolExecutor(1, "request"), ThreadPoolExecutor(STOP_THREADS, "stop")
        self._pending_count = self._stop_count = 0

    async def stop(self, request: Callable[[], object]) -> None:
        """Execute a request that stops the loop, at once, and wait for its end. Raises as `request`.

        The requests of `execute` that have not begun are withdrawn: each of their calls raises LoopFault. A request
        that has begun is not interrupted.
        """
        self._stop_count += 1
        await asyncio.get_running_loop().run_in_executor(self._stops, request)

    async def execute(self, request: Callable[[], object]) -> None:
        """Execute a request after all earlier requests of `execute`, and wait for its end.

        Raises LoopFault, with nothing sent, if MAX_PENDING requests wait or run, or if a stop came before this request
        began; else as `request`.
        """
        if self._pending_count >= MAX_PENDING:
            raise LoopFault(f"{self._pending_count} writes are pending; allowed: at most {MAX_PENDING}; write later")
        stop_count = self._stop_count

        def execute_unless_stopped() -> None:
            """Execute the request. Raises LoopFault if a stop came after the call of `execute`."""
            if self._stop_count != stop_count:
                raise LoopFault("this write was withdrawn: a stop was written after it")
            request()

        self._pending_count += 1
        try:
            await asyncio.get_running_loop().run_in_executor(self._ordinary, execute_unless_stopped)
        finally:
            self._pending_count -= 1

    def close(self) -> None:
        """Withdraw the requests that have not begun, whose calls raise CancelledError, and return at once.

        Requests that have begun end by themselves.
        """
        for executor in (self._ordinary, self._stops):
            executor.shutdown(wait=False, cancel_futures=True)
