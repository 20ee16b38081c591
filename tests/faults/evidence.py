"""Evidence of a bench: the board's record of the output, and the time that its processes waited for the host."""

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
"""Time-out of every wait. It is no bound of the product: a working service is faster, even on a busy host. pytest would
end a test after 300 s without naming the condition; in a row of the table, compiling may take minutes."""
POLL_S, SAFE_POLL_S = 0.01, 0.002
"""Polling a service more often would keep a processor busy. SAFE_POLL_S is shorter: the waiting time of a process can
only be read while the process exists."""
FULL_SCALE_V = 10.0
UNSEEN_SHARE = 0.25
"""Allowance for stalls that are not measured, as a share of the measured ones: while a thread that holds the
interpreter's lock is not run, no other thread is ready. Thirty processes on two processors made it a seventh."""


class OutputRecord(NamedTuple):
    """The board's record of its output, in V: voltages, the largest step of a write, the largest change in a window."""

    last_v: float
    lowest_v: float
    highest_v: float
    largest_step_v: float
    largest_window_v: float
    moved_ns: int
    unseen: int
    """Number of writes that the board lost from its FIFO or could not compare."""

    @property
    def largest_v(self) -> float:
        return max(-self.lowest_v, self.highest_v)

    def problems(self, bounds: Bounds) -> list[str]:
        """Return a sentence for each movement of the output that `bounds` do not allow."""
        problems = [f"{self.unseen} writes that the board could not compare"] if self.unseen else []
        if self.largest_v > FULL_SCALE_V:
            problems.append(f"a drive of {self.largest_v:.3f} V")
        if self.largest_step_v > bounds.step_v:
            problems.append(f"a step of {self.largest_step_v:.4f} V, allowed {bounds.step_v:.4f} V")
        if self.largest_window_v > bounds.window_v:
            problems.append(f"{self.largest_window_v:.4f} V within 1 ms, allowed {bounds.window_v:.4f} V")
        return problems


def wait_for(condition: Callable[[], Any], awaited: str, timeout_s: float = TIMEOUT_S, poll_s: float = POLL_S) -> Any:
    """Return the first true value of `condition`. Raises AssertionError, with the text `awaited`, at the time-out."""
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        if value := condition():
            return value
        time.sleep(poll_s)
    raise AssertionError(f"time-out after {timeout_s:g} s: {awaited}")


class Evidence:
    """Access to the memory of the board or the plain card in `folder`, and measurement of the host's stalls."""

    def __init__(self, folder: Path, card: bool) -> None:
        self.folder, self.card = folder, card
        self.records: list[OutputRecord] = []
        self.struck_ns = 0
        self.stalled_ms = 0.0
        """Time in ms that the host stalled between the newest fault and the safe output; see `await_safe`."""
        self._host: HostWitness | None = None
        self._waited_ns: dict[int, int] = {}
        self._strike_waited_ns = 0

    def safe_pids(self) -> list[int]:
        """Return the ids of the processes that move the output to safe: the service and the present loop."""
        raise NotImplementedError

    @property
    def memory(self) -> BoardMemory:
        """Memory of the board, mapped anew at each access."""
        fd = os.open(self.folder / "board", os.O_RDWR | os.O_CLOEXEC)
        try:
            return BoardMemory(fd)
        finally:
            os.close(fd)

    @property
    def resolution_v(self) -> float:
        """Smallest step of the output in V."""
        return plain_card.RESOLUTION_V if self.card else LSB_V

    def output_record(self) -> OutputRecord:
        """Return the record of the output, read from the board or the card."""
        if self.card:
            record, unseen = np.memmap(self.folder / "card", plain_card.MEMORY, "r", shape=(1,))[0], 0
        else:
            memory = self.memory
            record, unseen = memory.evidence[0], int(memory.words[board.MISSED_WRITES])
        names = ("last_v", "lowest_v", "highest_v", "largest_step_v", "largest_window_v")
        return OutputRecord(*(float(record[name]) for name in names), int(record["moved_ns"]), unseen)

    def cause_fault(self, fault: int) -> None:
        """Make the board or the card fail: `fault` is a constant of `hil.board` or of `plain_card`."""
        if self.card:
            np.memmap(self.folder / "card", plain_card.MEMORY, "r+", shape=(1,))["fault"] = fault
        else:
            self.memory.words[board.FAULT] = fault

    def strike(self, *faults: Callable[[], Any]) -> None:
        """Call each of `faults`, and store the time and the waiting times of the threads just before."""
        self._waited_ns = self._waited(every_thread=True)
        pid, before_ns = os.getpid(), waited_ns(os.getpid())
        self.struck_ns = time.monotonic_ns()
        for fault in faults:
            fault()
        self._strike_waited_ns = waited_ns(pid)[pid] - before_ns[pid]

    def _waited(self, every_thread: bool) -> dict[int, int]:
        """Return the ns that each thread of `safe_pids` waited for a processor, by thread id."""
        return {thread: ns for pid in self.safe_pids() for thread, ns in waited_ns(pid, every_thread).items()}

    def await_safe(self, bound_ms: float | None = None, by_request: bool = False) -> float:
        """Wait for 0 V; return the ms from the fault to the last movement of the output, by the card's time stamps.

        Raises AssertionError if that takes longer than `bound_ms` plus the stalls of the host. With `by_request`, the
        stalls of all threads and child processes count, because several of them work on a request.
        """
        waited_ns = dict(self._waited_ns)

        def is_safe() -> bool:
            waited_ns.update(self._waited(by_request))  # a loop that was killed waits too, until it is gone
            return self.output_record().last_v == 0.0

        wait_for(is_safe, "a safe output", poll_s=SAFE_POLL_S)
        took_ms = self._safe_ms(waited_ns)
        assert bound_ms is None or took_ms <= bound_ms + (1.0 + UNSEEN_SHARE) * self.stalled_ms, (
            f"safe after {took_ms:.0f} ms; allowed {bound_ms:g} ms, and the host stalled {self.stalled_ms:.0f} ms"
        )
        return took_ms

    def _safe_ms(self, thread_ns: dict[int, int]) -> float:
        """Return the ms from the fault to the last movement of the output; store the host's share in `stalled_ms`."""
        moved_ns = self.output_record().moved_ns
        assert self._host is not None
        waited_ns = sum(ns - self._waited_ns.get(thread, 0) for thread, ns in thread_ns.items())
        waited_ms = (self._strike_waited_ns + waited_ns) / NS_PER_MS
        self.stalled_ms = waited_ms + self._host.stolen_ms(self.struck_ns, moved_ns)
        return (moved_ns - self.struck_ns) / NS_PER_MS

    def store_record(self) -> None:
        """Append the present record of the output to `records`: a board that is started again begins a new one."""
        self.records.append(self.output_record())
