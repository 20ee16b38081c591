"""Whether ticks are recorded now, and how many are lost: read off the words that the recorder keeps."""

from __future__ import annotations

import os
from typing import Any

from rtloop.engine.memory import SharedBlock, Word
from rtloop.errors import LOW_SPACE

REASONS = {LOW_SPACE: "less space is free than is to stay free (recording.min_free_mib)"}
BEHIND = 4
"""A recorder that has not taken a quarter of what the ring holds, some seconds, is dead or stuck."""


def recording_state(block: SharedBlock) -> dict[str, Any]:
    """{state: "recording" or "not recording", reason, since_tick: first tick that is not recorded, ticks_lost}.

    `ticks_lost` counts all ticks of the loop that are in no file. It is 0 for a run that is recorded as a whole.
    """
    failure, flushed, lost, cursor = (
        block.load(word) for word in (Word.RECORDER_FAILURE, Word.FLUSHED_TICKS, Word.LOST_TICKS, Word.RECORDER_CURSOR)
    )
    reason, since_tick = None, None
    if failure:
        reason, since_tick = REASONS.get(failure) or os.strerror(failure), flushed
        lost += max(cursor - flushed, 0)
    elif int(block["ticks_head"][0]) - cursor > len(block["ticks_slots"]) // BEHIND:
        reason, since_tick = "the recorder takes no ticks", cursor
    state = "recording" if reason is None else "not recording"
    return {"state": state, "reason": reason, "since_tick": since_tick, "ticks_lost": lost}


def recording_fault(block: SharedBlock) -> str | None:
    """Why ticks are not recorded now, in words that stay the same as long as the fault does; None while they are."""
    said = recording_state(block)
    return said["reason"] and f"not recorded from tick {said['since_tick']} on: {said['reason']}"
