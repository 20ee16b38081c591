"""Whether ticks are recorded now, and how many are lost: read off the words that the recorder keeps."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

from rtloop.engine.memory import SharedBlock, Word
from rtloop.errors import LOW_SPACE
from rtloop.values import count_text

REASONS = {LOW_SPACE: "less space is free than is to stay free (recording.min_free_mib)"}
BEHIND_DIVISOR = 4
"""A recorder that has not taken a quarter of what the ring holds, some seconds, is dead or stuck."""
QUIET_S = 1.0
"""Without a fault, before a gap is over; as with ticks that are late."""


def recording_state(block: SharedBlock) -> dict[str, Any]:
    """{state: "recording" or "not recording", reason, since_tick: first tick that is not recorded, ticks_lost}.

    `ticks_lost` counts all ticks of the loop that are in no file. It is 0 for a run that is recorded as a whole.
    """
    failure, flushed_ticks, lost_ticks, cursor = (
        block.load(word) for word in (Word.RECORDER_FAILURE, Word.FLUSHED_TICKS, Word.LOST_TICKS, Word.RECORDER_CURSOR)
    )
    reason, since_tick = None, None
    if failure:
        reason, since_tick = REASONS.get(failure) or os.strerror(failure), flushed_ticks
        lost_ticks += max(cursor - flushed_ticks, 0)
    elif int(block["ticks_head"][0]) - cursor > len(block["ticks_slots"]) // BEHIND_DIVISOR:
        reason, since_tick = "the recorder takes no ticks", cursor
    state = "recording" if reason is None else "not recording"
    return {"state": state, "reason": reason, "since_tick": since_tick, "ticks_lost": lost_ticks}


class GapReporter:
    """Tells each stretch of time in which ticks are not recorded twice: as it begins, and once it is over.

    It is over when nothing was amiss for QUIET_S: on a host that is overloaded the recorder is behind, catches up a
    little and is behind again, and all of that is one stretch.
    """

    def __init__(self, block: SharedBlock, now_s: Callable[[], float] = time.monotonic) -> None:
        self._block, self._now_s = block, now_s
        self._reasons: set[str] = set()
        """Said of the stretch that is not over; empty where there is none."""
        self._gap_begin_s = self._last_fault_s = 0.0
        self._reported_lost_ticks = 0

    def next_message(self) -> str | None:
        """What is to be said now; None where there is nothing."""
        state, now_s = recording_state(self._block), self._now_s()
        if (reason := state["reason"]) is not None:
            self._last_fault_s = now_s
            if not self._reasons:
                self._gap_begin_s = now_s
            if reason in self._reasons:
                return None
            self._reasons.add(reason)
            return f"not recorded from tick {state['since_tick']} on: {reason}"
        if self._reasons and now_s - self._last_fault_s < QUIET_S:
            return None
        lost_ticks, self._reported_lost_ticks = state["ticks_lost"] - self._reported_lost_ticks, state["ticks_lost"]
        if not self._reasons:
            return None
        self._reasons.clear()
        gap_s = self._last_fault_s - self._gap_begin_s
        return f"recorded again after {gap_s:.1f} s; {count_text(lost_ticks, 'tick')} lost"
