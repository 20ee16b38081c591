"""What the service says of the recording, from the words of the shared block."""

from __future__ import annotations

import errno

import pytest

from rtloop.engine.memory import SharedBlock, Word
from rtloop.errors import LOW_SPACE
from rtloop.supervision.recording_state import recording_fault, recording_state
from tests.recording.hand_made_loop import HandMadeLoop


def block(executed: int, **words: int) -> SharedBlock:
    made = HandMadeLoop().block
    made["ticks_head"][0] = executed
    for name, value in words.items():
        made.store(Word[name], value)
    return made


def test_recording():
    running = block(20_000, RECORDER_CURSOR=19_990, FLUSHED_TICKS=15_000)
    assert recording_state(running) == {"state": "recording", "reason": None, "since_tick": None, "ticks_lost": 0}
    assert recording_fault(running) is None


def test_a_loss_in_the_past_stays_said():
    again = block(90_000, RECORDER_CURSOR=90_000, FLUSHED_TICKS=80_000, LOST_TICKS=1_234)
    assert recording_state(again) == {"state": "recording", "reason": None, "since_tick": None, "ticks_lost": 1_234}
    assert recording_fault(again) is None


@pytest.mark.parametrize(
    ("number", "reason"),
    [(errno.ENOSPC, "No space left on device"), (errno.ENOENT, "No such file"), (LOW_SPACE, "min_free_mib")],
)
def test_a_failure(number: int, reason: str):
    full = block(20_000, RECORDER_CURSOR=19_990, FLUSHED_TICKS=15_000, LOST_TICKS=100, RECORDER_FAILURE=number)
    said = recording_state(full)
    assert (said["state"], said["since_tick"], said["ticks_lost"]) == ("not recording", 15_000, 100 + 4_990)
    assert reason in said["reason"]
    fault = recording_fault(full)
    full.store(Word.RECORDER_CURSOR, 20_000)
    assert fault == recording_fault(full)  # the same words as long as it is the same fault
    assert reason in fault
    assert "15000" in fault


def test_a_recorder_that_takes_nothing():
    stuck = block(60_000, RECORDER_CURSOR=2_000, FLUSHED_TICKS=1_000)
    said = recording_state(stuck)
    assert (said["state"], said["since_tick"], said["ticks_lost"]) == ("not recording", 2_000, 0)
    assert "58000" not in recording_fault(stuck)
