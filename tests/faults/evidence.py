"""What the board of a bench says: the only witness of what its outputs did."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtloop.hil import board
from rtloop.hil.board import LSB_V, BoardMemory
from tests.faults import plain_card
from tests.faults.configuration import SLEW_V_PER_S

TIMEOUT_S = 60.0
POLL_S = 0.002


class Seen(NamedTuple):
    """What the board says of its output. `largest_step_v` is the largest from one write to the next."""

    last_v: float
    lowest_v: float
    highest_v: float
    largest_step_v: float
    moved_ns: int
    unseen: int
    """Writes that it came too late to see."""

    @property
    def largest_v(self) -> float:
        return max(-self.lowest_v, self.highest_v)


def wait_for(condition: Callable[[], Any], what: str, timeout_s: float = TIMEOUT_S) -> Any:
    """The first true value of `condition`; a failure that names `what` once the time is over."""
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        if value := condition():
            return value
        time.sleep(POLL_S)
    raise AssertionError(f"not within {timeout_s:g} s: {what}")


class Evidence:
    """The memory of the board, or of the plain card, in `folder`."""

    def __init__(self, folder: Path, card: bool) -> None:
        self.folder, self.card = folder, card
        self.witnessed: list[Seen] = []
        self.struck_ns = 0

    @property
    def memory(self) -> BoardMemory:
        """The board's memory."""
        fd = os.open(self.folder / "board", os.O_RDWR | os.O_CLOEXEC)
        try:
            return BoardMemory(fd)
        finally:
            os.close(fd)

    def seen(self) -> Seen:
        """What the output did, read from the board."""
        if self.card:
            record = np.memmap(self.folder / "card", plain_card.MEMORY, "r", shape=(1,))[0]
            step, unseen = "largest_step_v", 0
        else:
            memory = self.memory
            record, step, unseen = memory.seen[0], "largest_write_step_v", int(memory.words[board.UNSEEN])
        values = [record[name] for name in ("last_v", "lowest_v", "highest_v", step)]
        return Seen(*map(float, values), int(record["moved_ns"]), unseen)

    def ask_for(self, fault: int) -> None:
        """A fault of the board or of the card."""
        if self.card:
            np.memmap(self.folder / "card", plain_card.MEMORY, "r+", shape=(1,))["fault"] = fault
        else:
            self.memory.words[board.FAULT] = fault

    def strike(self, *faults: Callable[[], Any]) -> None:
        """Bring about a fault, and remember when."""
        self.struck_ns = time.monotonic_ns()
        for fault in faults:
            fault()

    def await_safe(self, within_ms: float) -> float:
        """ms from the fault until the output was at 0 V for good, by the board's own clock."""
        wait_for(lambda: self.seen().last_v == 0.0, "a safe output")
        took_ms = (self.seen().moved_ns - self.struck_ns) / 1e6
        assert took_ms <= within_ms, f"safe after {took_ms:.0f} ms, allowed {within_ms:g} ms"
        return took_ms

    def witness(self) -> None:
        """Keep what the board says now: a board that is started again forgets."""
        self.witnessed.append(self.seen())


def step_bound_v(rate_hz: float) -> float:
    """What slew and ramps allow from one write to the next, whatever the time between them."""
    return 1.05 * SLEW_V_PER_S / rate_hz + LSB_V
