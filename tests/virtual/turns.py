"""Virtual time: threads take turns, and no second passes by itself.

A thread gives up its turn in `wait`, for a time or until a condition holds; the next turn is that of the thread that
may go on first, after the world was advanced until then. The order of all work is therefore the same in every run,
whatever the host does.
"""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

from rtloop.foundation import timing

UNIX_S = 1.8e9
POLL_S = 0.005
"""Time after which the conditions are looked at again, if nothing happens before."""
REAL_LIMIT_S = 600.0
"""Real time in which a turn must end: a kernel is perhaps compiled in it, on a busy host."""
LONGEST_S = 10_000.0
"""Time after which a wait that nothing ends counts as a deadlock."""


def never() -> bool:
    """Return False: the condition of a thread that sleeps."""
    return False


class EndOfTest(BaseException):
    """The test has ended, and with it each other thread."""


class Turns:
    """Turns of threads in virtual time; `advance` is called for each stretch of it."""

    def __init__(
        self,
        advance: Callable[[float], None],
        choose: Callable[[list[threading.Thread]], threading.Thread] = lambda ready: ready[0],
        delay: Callable[[], float] = lambda: 0.0,
        line_delay: Callable[[], float] | None = None,
        traced: Sequence[str] = (),
    ) -> None:
        """`choose` picks among threads that may go on at once; `delay` draws the time (s) by which a thread that has
        its turn goes on later, as on a busy host; `line_delay` draws it before each line of the files below the
        folders `traced`, where a real thread may lose its turn too.
        """
        self.now_s, self._advance, self._choose, self._delay = 1000.0, advance, choose, delay
        self._line_delay, self._traced, self._is_traced = line_delay, tuple(traced), dict[str, bool]()
        self.on_resume: Callable[[], None] = lambda: None
        """Called by a thread that had lost its turn in `preempt` and has it again; may raise."""
        self._is_passing = False
        self._waits: dict[threading.Thread, tuple[float, Callable[[], object]]] = {}
        self._gates: dict[threading.Thread, threading.Lock] = {}
        """A lock for each thread, which it takes to wait and the thread before it releases."""
        self._turn: threading.Thread | None = threading.current_thread()
        self._enter(threading.current_thread())

    def _enter(self, thread: threading.Thread) -> None:
        self._gates[thread] = threading.Lock()
        self._gates[thread].acquire()
        self._waits[thread] = self.now_s, never

    def end(self) -> None:
        """End all other threads, where they sleep."""
        threads, self._turn = [*self._waits], None
        for thread in threads:
            if thread is not threading.current_thread():
                self._gates[thread].release()
        for thread in threads:
            if thread is not threading.current_thread():
                threading.Thread.join(thread)

    def sleep(self, seconds: float) -> None:
        """Give up the turn for a time, in which other threads have theirs."""
        self.wait(never, seconds)

    def wait(self, condition: Callable[[], object], seconds: float = math.inf) -> None:
        """Give up the turn until a condition holds, and for `seconds` at most."""
        self._give_up_turn(self.now_s + seconds, condition)
        if (delay_s := self._delay()) > 0:
            self._give_up_turn(self.now_s + delay_s, never)

    def preempt(self, delay: Callable[[], float] | None = None) -> None:
        """Give up the turn for a drawn delay, mostly for none."""
        has_turn = self._turn is threading.current_thread() and not self._is_passing
        if has_turn and (delay_s := (delay or self._delay)()) > 0:
            self._give_up_turn(self.now_s + delay_s, never)
            self.on_resume()

    @contextmanager
    def undivided(self) -> Iterator[None]:
        """Keep the turn: within, no thread loses it by `preempt`."""
        before, self._is_passing = self._is_passing, True
        try:
            yield
        finally:
            self._is_passing = before

    def trace(self, frame: FrameType, event: str, _: object) -> Callable[..., Any] | None:
        """Give up the turn before lines of the traced files: a trace function, as of `sys.settrace`."""
        if event == "call":
            name = frame.f_code.co_filename
            if name not in self._is_traced:
                self._is_traced[name] = name.startswith(self._traced)
            return self.trace if self._is_traced[name] and frame.f_code.co_name != "<module>" else None
        if event == "line":
            self.preempt(self._line_delay)
        return self.trace

    def _give_up_turn(self, until_s: float, condition: Callable[[], object]) -> None:
        if self._turn is None:
            raise EndOfTest
        me = threading.current_thread()
        self._waits[me] = until_s, condition
        self._pass_on()
        self._await_turn(me)

    def start(self, work: Callable[[], object]) -> threading.Thread:
        """Start a thread whose first turn comes at once; its turns end with `work`."""

        def run() -> None:
            try:
                self._await_turn(thread)
                if self._line_delay is not None:
                    sys.settrace(self.trace)
                work()
            except EndOfTest:
                pass
            finally:
                sys.settrace(None)
                thread.has_ended = True
                del self._waits[thread]
                if self._turn is thread:
                    self._pass_on()

        thread = VirtualThread(self, run)
        self._enter(thread)
        thread.start()
        return thread

    def _pass_on(self) -> None:
        """Give the turn to the thread that may go on first, after the time until then."""
        last_s, self._is_passing = self.now_s + LONGEST_S, True
        while True:
            assert self.now_s < last_s, "each thread waits for another one"
            wakes_s = {thread: self._wake_s(*wait) for thread, wait in self._waits.items()}
            first_s = min(wakes_s.values())
            turn = self._choose([thread for thread, wake_s in wakes_s.items() if wake_s == first_s])
            end_s = max(min(wakes_s[turn], self.now_s + POLL_S), self.now_s)
            self._advance(end_s - self.now_s)
            self.now_s = end_s
            if end_s >= wakes_s[turn]:
                break
        self._turn, self._is_passing = turn, False
        self._gates[turn].release()

    def _wake_s(self, end_s: float, condition: Callable[[], object]) -> float:
        return self.now_s if condition() else end_s

    def _await_turn(self, me: threading.Thread) -> None:
        has_turn = self._gates[me].acquire(timeout=REAL_LIMIT_S)
        assert has_turn, "no turn: a thread waits for a real lock"
        if self._turn is None:
            raise EndOfTest


class VirtualThread(threading.Thread):
    """Thread whose end is awaited in virtual time."""

    def __init__(self, turns: Turns, work: Callable[[], None]) -> None:
        super().__init__(target=work, daemon=True)
        self._turns, self.has_ended = turns, False

    def is_alive(self) -> bool:
        return super().is_alive() and not self.has_ended

    def join(self, timeout: float | None = None) -> None:
        self._turns.wait(lambda: not self.is_alive(), math.inf if timeout is None else timeout)


class VirtualLock:
    """Lock for which a thread waits in virtual time."""

    def __init__(self, turns: Turns, lock: Any) -> None:
        self._turns, self._lock, self._holds = turns, lock, 0

    def __enter__(self) -> None:
        while not self._lock.acquire(blocking=False):
            self._turns.wait(lambda: not self.locked())
        self._holds += 1

    def __exit__(self, *_: object) -> None:
        self._holds -= 1
        self._lock.release()

    def locked(self) -> bool:
        return self._holds > 0


class VirtualEvent(threading.Event):
    """Event for which a thread waits in virtual time."""

    def __init__(self, turns: Turns) -> None:
        super().__init__()
        self._turns = turns

    def wait(self, timeout: float | None = None) -> bool:
        self._turns.wait(self.is_set, math.inf if timeout is None else timeout)
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
