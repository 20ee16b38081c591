"""State of the recording: whether ticks are recorded now, and how many are lost, from the recorder's shared words."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, Protocol, TypedDict

import numpy as np

from rtloop.engine.memory import SharedBlock, Word
from rtloop.errors import LOW_SPACE
from rtloop.foundation import timing
from rtloop.values import count_text

REASONS = {
    LOW_SPACE: "the disk has too little free space; delete or move files; the recording continues once 1.25 times "
    "recording.min_free_mib plus 1 MiB are free"
}
BEHIND_DIVISOR = 4
"""A recorder that is behind by more than a quarter of the ring (some seconds) is dead or stuck."""
QUIET_S = 1.0
"""A gap ends after this time without a fault."""


class ReadableBlock(Protocol):
    """A shared block, of which control words and arrays can be read."""

    def load(self, word: Word) -> int:
        """Return a control word."""
        ...

    def __getitem__(self, name: str) -> np.ndarray[Any, Any]:
        """Return an array by its name."""
        ...


class RecordingState(TypedDict):
    """Whether ticks are recorded now; the fields are described at `recording_state`."""

    state: str
    reason: str | None
    since_tick: int | None
    ticks_lost: int


def recording_state(block: ReadableBlock) -> RecordingState:
    """Return {state: "recording" or "not recording", reason, since_tick: first tick without record, ticks_lost}.

    `ticks_lost` counts the ticks that are in no file although the recorder has passed them: ticks that still wait in
    the ring do not count. `reason` and `since_tick` are None while recording.
    """
    failure, flushed_ticks, lost_ticks, cursor = (
        block.load(word) for word in (Word.RECORDER_FAILURE, Word.FLUSHED_TICKS, Word.LOST_TICKS, Word.RECORDER_CURSOR)
    )
    reason, since_tick = None, None
    if failure:
        reason, since_tick = REASONS.get(failure) or os.strerror(failure), flushed_ticks
        lost_ticks += max(cursor - flushed_ticks, 0)
    elif int(block["ticks_head"][0]) - cursor > len(block["ticks_slots"]) // BEHIND_DIVISOR:
        reason, since_tick = "the recorder has stopped or is too slow", cursor
    state = "recording" if reason is None else "not recording"
    return {"state": state, "reason": reason, "since_tick": since_tick, "ticks_lost": lost_ticks}


class GapReporter:
    """Messages about gaps, in which ticks are not recorded: one for each reason of a gap, one at its end.

    A gap ends after QUIET_S without a fault: on an overloaded host the recorder is behind, catches up a little and is
    behind again, which is one gap.
    """

    def __init__(self, block: SharedBlock, now_s: Callable[[], float] = timing.monotonic_s) -> None:
        """Report gaps of the recording on `block`; `now_s` returns a monotonic time in s."""
        self._block, self._now_s = block, now_s
        self._reasons: set[str] = set()
        """Reasons reported for the open gap; empty without one."""
        self._gap_begin_s = self._last_fault_s = 0.0
        self._reported_lost_ticks = 0

    def next_message(self) -> str | None:
        """Return the message that is due now, or None: each reason of a gap is due once, then the end of the gap."""
        state, now_s = recording_state(self._block), self._now_s()
        if (reason := state["reason"]) is not None:
            self._last_fault_s = now_s
            if not self._reasons:
                self._gap_begin_s = now_s
            if reason in self._reasons:
                return None
            self._reasons.add(reason)
            return f"ticks are not recorded from tick {state['since_tick']} on: {reason}"
        if self._reasons and now_s - self._last_fault_s < QUIET_S:
            return None
        lost_ticks, self._reported_lost_ticks = state["ticks_lost"] - self._reported_lost_ticks, state["ticks_lost"]
        if not self._reasons:
            return None
        self._reasons.clear()
        gap_s = self._last_fault_s - self._gap_begin_s
        return f"ticks are recorded again after {gap_s:.1f} s; {count_text(lost_ticks, 'tick')} lost"
