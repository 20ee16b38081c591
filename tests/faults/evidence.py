"""Evidence of a bench: what its board saw of the output, and for how long the host kept its processes waiting."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtloop.hil import board
from rtloop.hil.board import LSB_V, BoardMemory
from tests.faults import plain_card
from tests.faults.configuration import Bounds
from tests.faults.host import NS_PER_MS, HostWitness, waited_ns

TIMEOUT_S = 240.0 if "pytest" in sys.modules else 600.0
"""Nothing that works takes so long, on a host with little to spare; no bound on anything. A test ends after 300 s, and
would then not say what it waited for; elsewhere a row may compile everything beside other compilers."""
POLL_S, SAFE_POLL_S = 0.01, 0.002
"""Who asks a service more often keeps a processor busy; what a process waited is read while it is still there."""
FULL_SCALE_V = 10.0
UNSEEN_SHARE = 0.25
"""Beside what is measured the host takes a little more: while another thread holds the interpreter's lock and is not
run, nobody is ready. With thirty processes on two processors that was a seventh; without any, nothing is added."""


class Seen(NamedTuple):
    """What the board says of its output: voltages, the largest step of a write and change within a window, in V."""

    last_v: float
    lowest_v: float
    highest_v: float
    largest_step_v: float
    largest_window_v: float
    moved_ns: int
    unseen: int
    """Writes that it came too late to see."""

    @property
    def largest_v(self) -> float:
        return max(-self.lowest_v, self.highest_v)

    def problems(self, bounds: Bounds) -> list[str]:
        """Sentences about what the output must not have done."""
        found = [f"{self.unseen} writes that the board came too late to see"] if self.unseen else []
        if self.largest_v > FULL_SCALE_V:
            found.append(f"a drive of {self.largest_v:.3f} V")
        if self.largest_step_v > bounds.step_v:
            found.append(f"a step of {self.largest_step_v:.4f} V, allowed {bounds.step_v:.4f} V")
        if self.largest_window_v > bounds.window_v:
            found.append(f"{self.largest_window_v:.4f} V within 1 ms, allowed {bounds.window_v:.4f} V")
        return found


def wait_for(condition: Callable[[], Any], what: str, timeout_s: float = TIMEOUT_S, poll_s: float = POLL_S) -> Any:
    """The first true value of `condition`; an AssertionError that names `what` at the time-out."""
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        if value := condition():
            return value
        time.sleep(poll_s)
    raise AssertionError(f"time-out after {timeout_s:g} s: {what}")


class Evidence:
    """The memory of the board, or of the plain card, in `folder`, and the witness of the host."""

    def __init__(self, folder: Path, card: bool) -> None:
        self.folder, self.card = folder, card
        self.witnessed: list[Seen] = []
        self.struck_ns = 0
        self.stalled_ms = 0.0
        """What the host took between the newest fault and the safe output; see `await_safe`."""
        self._host: HostWitness | None = None
        self._waited_ns: dict[int, int] = {}
        self._strike_waited_ns = 0

    def safe_pids(self) -> list[int]:
        """Processes that bring the output to safe: the service and the present loop."""
        raise NotImplementedError

    @property
    def memory(self) -> BoardMemory:
        """The board's memory."""
        fd = os.open(self.folder / "board", os.O_RDWR | os.O_CLOEXEC)
        try:
            return BoardMemory(fd)
        finally:
            os.close(fd)

    @property
    def resolution_v(self) -> float:
        """Between two voltages that the hardware can tell apart."""
        return plain_card.RESOLUTION_V if self.card else LSB_V

    def seen(self) -> Seen:
        """What the output did, read from the board."""
        if self.card:
            record, unseen = np.memmap(self.folder / "card", plain_card.MEMORY, "r", shape=(1,))[0], 0
        else:
            memory = self.memory
            record, unseen = memory.evidence[0], int(memory.words[board.MISSED_WRITES])
        names = ("last_v", "lowest_v", "highest_v", "largest_step_v", "largest_window_v")
        return Seen(*(float(record[name]) for name in names), int(record["moved_ns"]), unseen)

    def ask_for(self, fault: int) -> None:
        """A fault of the board or of the card."""
        if self.card:
            np.memmap(self.folder / "card", plain_card.MEMORY, "r+", shape=(1,))["fault"] = fault
        else:
            self.memory.words[board.FAULT] = fault

    def strike(self, *faults: Callable[[], Any]) -> None:
        """Bring about a fault, and remember when."""
        self._waited_ns = self._waited(every_thread=True)
        own, before_ns = os.getpid(), waited_ns(os.getpid())
        self.struck_ns = time.monotonic_ns()
        for fault in faults:
            fault()
        self._strike_waited_ns = waited_ns(own)[own] - before_ns[own]

    def _waited(self, every_thread: bool) -> dict[int, int]:
        """ns that each thread waited for a processor, by its number."""
        return {thread: ns for pid in self.safe_pids() for thread, ns in waited_ns(pid, every_thread).items()}

    def await_safe(self, bound_ms: float | None = None, by_request: bool = False) -> float:
        """ms from the fault until the output was at 0 V for good, by the card's own clock.

        That must take no longer than `bound_ms`, where there is one, and what the host took meanwhile. What came
        `by_request` passed through several threads of the service, and perhaps another process.
        """
        waited_ns = dict(self._waited_ns)

        def is_safe() -> bool:
            waited_ns.update(self._waited(by_request))  # a loop that was killed waits too, until it is gone
            return self.seen().last_v == 0.0

        wait_for(is_safe, "a safe output", poll_s=SAFE_POLL_S)
        took_ms = self._safe_ms(waited_ns)
        assert bound_ms is None or took_ms <= bound_ms + (1.0 + UNSEEN_SHARE) * self.stalled_ms, (
            f"safe after {took_ms:.0f} ms; allowed {bound_ms:g} ms, and the host stalled {self.stalled_ms:.0f} ms"
        )
        return took_ms

    def _safe_ms(self, thread_ns: dict[int, int]) -> float:
        """ms from the fault until the output moved last; notes what the host took of them."""
        moved_ns = self.seen().moved_ns
        assert self._host is not None
        waited_ns = sum(ns - self._waited_ns.get(thread, 0) for thread, ns in thread_ns.items())
        waited_ms = (self._strike_waited_ns + waited_ns) / NS_PER_MS
        self.stalled_ms = waited_ms + self._host.stolen_ms(self.struck_ns, moved_ns)
        return (moved_ns - self.struck_ns) / NS_PER_MS

    def witness(self) -> None:
        """Keep what the board says now: a board that is started again forgets."""
        self.witnessed.append(self.seen())
