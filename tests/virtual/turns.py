"""Virtual time: threads take turns, and no second passes by itself.

A thread gives up its turn in `sleep`; the next turn is that of the thread that wakes first, after the world was
advanced until then. The order of all work is therefore the same in every run, whatever the host does.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from rtloop.foundation import timing

LOCK_POLL_S, EVENT_POLL_S, UNIX_S = 0.0005, 0.005, 1.8e9


class EndOfTest(BaseException):
    """The test has ended, and with it each other thread."""


class Turns:
    """Turns of threads in virtual time; `advance` is called for each stretch of it."""

    def __init__(self, advance: Callable[[float], None]) -> None:
        self.now_s, self._advance = 1000.0, advance
        self._changed = threading.Condition()
        self._wakes_s: dict[threading.Thread, float] = {threading.current_thread(): self.now_s}
        self._turn: threading.Thread | None = threading.current_thread()

    def end(self) -> None:
        """End all other threads, where they sleep."""
        with self._changed:
            threads, self._turn = [*self._wakes_s], None
            self._changed.notify_all()
        for thread in threads:
            if thread is not threading.current_thread():
                threading.Thread.join(thread)

    def sleep(self, seconds: float) -> None:
        """Give up the turn for a time, in which other threads have theirs."""
        me = threading.current_thread()
        with self._changed:
            self._wakes_s[me] = self.now_s + seconds
            self._pass_on()
            self._await_turn(me)

    def start(self, work: Callable[[], object]) -> threading.Thread:
        """Start a thread whose first turn comes at once; its turns end with `work`."""

        def run() -> None:
            try:
                with self._changed:
                    self._await_turn(thread)
                work()
            except EndOfTest:
                pass
            finally:
                with self._changed:
                    del self._wakes_s[thread]
                    if self._turn is thread:
                        self._pass_on()

        thread = VirtualThread(self, run)
        self._wakes_s[thread] = self.now_s
        thread.start()
        return thread

    def _pass_on(self) -> None:
        """Give the turn to the thread that wakes first, after the time until then."""
        self._turn = min(self._wakes_s, key=lambda thread: self._wakes_s[thread])
        wake_s = max(self._wakes_s[self._turn], self.now_s)
        self._advance(wake_s - self.now_s)
        self.now_s = wake_s
        self._changed.notify_all()

    def _await_turn(self, me: threading.Thread) -> None:
        assert self._changed.wait_for(lambda: self._turn in (me, None), 60.0), "no turn: a thread waits for a real lock"
        if self._turn is None:
            raise EndOfTest


class VirtualThread(threading.Thread):
    """Thread whose end is awaited in virtual time."""

    def __init__(self, turns: Turns, work: Callable[[], None]) -> None:
        super().__init__(target=work, daemon=True)
        self._turns = turns

    def join(self, timeout: float | None = None) -> None:
        end_s = self._turns.now_s + (float("inf") if timeout is None else timeout)
        while self.is_alive() and self._turns.now_s < end_s:
            self._turns.sleep(EVENT_POLL_S)


class VirtualLock:
    """Lock for which a thread waits in virtual time."""

    def __init__(self, turns: Turns, lock: Any) -> None:
        self._turns, self._lock = turns, lock

    def __enter__(self) -> None:
        while not self._lock.acquire(blocking=False):
            self._turns.sleep(LOCK_POLL_S)

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def locked(self) -> bool:
        return bool(self._lock.locked())


class VirtualEvent(threading.Event):
    """Event for which a thread waits in virtual time."""

    def __init__(self, turns: Turns) -> None:
        super().__init__()
        self._turns = turns

    def wait(self, timeout: float | None = None) -> bool:
        end_s = self._turns.now_s + (float("inf") if timeout is None else timeout)
        while not self.is_set() and self._turns.now_s < end_s:
            self._turns.sleep(min(EVENT_POLL_S, end_s - self._turns.now_s))
        return self.is_set()


def virtual_time(turns: Turns) -> timing.Source:
    """Return the product's source of time in which threads take turns."""
    make: Any = VirtualLock
    return timing.Source(
        monotonic_s=lambda: turns.now_s,
        unix_s=lambda: UNIX_S + turns.now_s,
        sleep=turns.sleep,
        lock=lambda: make(turns, threading.Lock()),
        reentrant_lock=lambda: make(turns, threading.RLock()),
        event=lambda: VirtualEvent(turns),
        start_thread=turns.start,
    )
