"""Waiting time of `rtloop park` for a loop that outlived its service, in simulated time: no ramp is cut short."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.drivers.errors import DriverError
from rtloop.engine.memory import Word
from rtloop.foundation import timing
from rtloop.supervision import parking

HEARTBEAT_TIMEOUT_S, SLEW_V_PER_S = 1.5, 2.0


class DrivenBlock:
    """Block whose loop runs until it is killed at `killed_s`, or for ever; `now_s` is the simulated time."""

    def __init__(self, drives_v: list[float], *, can_be_killed: bool = True) -> None:
        self.now_s, self.killed_s, self._can_be_killed = 100.0, None, can_be_killed
        self._fields = {"last_drive_v": np.array(drives_v)}

    def __getitem__(self, name: str):
        return self._fields[name]

    def load(self, word: Word) -> int:
        assert word is Word.HEARTBEAT_NS
        return 7

    def driver_pid(self) -> int | None:
        return None if self.killed_s is not None and self._can_be_killed else 4711

    def kill_driver(self) -> None:
        self.killed_s = self.killed_s or self.now_s

    def sleep(self, duration_s: float) -> None:
        self.now_s += duration_s


def await_end(block: DrivenBlock, safe_v: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for the end of the block's loop in the block's simulated time."""
    monkeypatch.setattr(timing, "source", timing.Source(monotonic_s=lambda: block.now_s, sleep=block.sleep))
    parking._await_end(block, HEARTBEAT_TIMEOUT_S, SLEW_V_PER_S, np.array(safe_v))  # type: ignore[arg-type]


@pytest.mark.parametrize("drives_v", [[9.0], [0.5, -9.0], [9.0, 0.5]])
def test_a_loop_has_the_time_of_its_timeout_and_of_its_longest_ramp(drives_v, monkeypatch):
    """A ramp of 9 V at 2 V/s takes 4.5 s, and begins 1.5 s after the last heartbeat."""
    block = DrivenBlock(drives_v)
    await_end(block, [0.0] * len(drives_v), monkeypatch)
    assert block.killed_s == pytest.approx(100.0 + 4.5 + 1.5 + parking.MARGIN_S, abs=2 * parking.POLL_S)


@pytest.mark.parametrize(
    ("drives_v", "safe_v", "ramp_s"),
    [
        ([0.5], [8.5], 4.0),
        ([9.0], [8.5], 0.25),
        ([-2.0, 5.0], [3.0, 5.0], 2.5),
        ([5.0, -2.0], [5.0, 3.0], 2.5),
        ([0.0, 0.0], [0.0], parking.LONGEST_RAMP_S),
    ],
)
def test_a_ramp_leads_to_the_safe_value_which_need_not_be_0(drives_v, safe_v, ramp_s, monkeypatch):
    """The ramp has 2 V/s. For a block with another number of axes than the board, the longest ramp is assumed."""
    block = DrivenBlock(drives_v)
    await_end(block, safe_v, monkeypatch)
    assert block.killed_s == pytest.approx(100.0 + ramp_s + 1.5 + parking.MARGIN_S, abs=2 * parking.POLL_S)


def test_a_loop_that_cannot_be_killed_is_told(monkeypatch):
    block = DrivenBlock([0.0], can_be_killed=False)
    with pytest.raises(DriverError, match="process 4711 drives the outputs and cannot be killed"):
        await_end(block, [0.0], monkeypatch)
    end_s = 100.0 + 1.5 + parking.MARGIN_S + parking.KILL_S
    assert block.now_s == pytest.approx(end_s, abs=2 * parking.POLL_S)
