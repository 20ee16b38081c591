"""State of the recording, and messages about its gaps, from the words of the shared block."""

from __future__ import annotations

import errno

import pytest

from rtloop.engine.memory import SharedBlock, Word
from rtloop.errors import LOW_SPACE
from rtloop.supervision.recording_state import QUIET_S, GapReporter, recording_state
from tests.recording.hand_made_loop import HandMadeLoop


def make_block(executed: int, **words: int) -> SharedBlock:
    """Return a shared block with `executed` ticks and the given words."""
    block = HandMadeLoop().block
    block["ticks_head"][0] = executed
    for name, value in words.items():
        block.store(Word[name], value)
    return block


def test_recording():
    running = make_block(20_000, RECORDER_CURSOR=19_990, FLUSHED_TICKS=15_000)
    assert recording_state(running) == {"state": "recording", "reason": None, "since_tick": None, "ticks_lost": 0}
    assert GapReporter(running).next_message() is None


def test_a_loss_in_the_past_stays_said():
    recovered = make_block(90_000, RECORDER_CURSOR=90_000, FLUSHED_TICKS=80_000, LOST_TICKS=1_234)
    assert recording_state(recovered) == {"state": "recording", "reason": None, "since_tick": None, "ticks_lost": 1_234}
    assert GapReporter(recovered).next_message() is None


@pytest.mark.parametrize(
    ("number", "reason"),
    [(errno.ENOSPC, "No space left on device"), (errno.ENOENT, "No such file"), (LOW_SPACE, "min_free_mib")],
)
def test_a_failure(number: int, reason: str):
    full = make_block(20_000, RECORDER_CURSOR=19_990, FLUSHED_TICKS=15_000, LOST_TICKS=100, RECORDER_FAILURE=number)
    state = recording_state(full)
    assert (state["state"], state["since_tick"], state["ticks_lost"]) == ("not recording", 15_000, 100 + 4_990)
    assert reason in state["reason"]
    gaps = GapReporter(full)
    assert "from tick 15000 on" in (message := gaps.next_message() or "")
    assert reason in message
    full.store(Word.RECORDER_CURSOR, 20_000)
    assert gaps.next_message() is None


def test_a_recorder_that_takes_nothing():
    stuck = make_block(60_000, RECORDER_CURSOR=2_000, FLUSHED_TICKS=1_000)
    state = recording_state(stuck)
    assert (state["state"], state["since_tick"], state["ticks_lost"]) == ("not recording", 2_000, 0)
    assert "58000" not in (GapReporter(stuck).next_message() or "")


def test_a_recorder_that_is_behind_again_and_again_is_told_of_once_and_then_how_long_and_how_much():
    now_s = [100.0]
    slow = make_block(60_000, RECORDER_CURSOR=59_000, FLUSHED_TICKS=59_000, LOST_TICKS=70)
    gaps, messages = GapReporter(slow, lambda: now_s[0]), []

    def update(cursor: int, lost: int, after_s: float) -> None:
        now_s[0] += after_s
        slow.store(Word.RECORDER_CURSOR, cursor)
        slow.store(Word.LOST_TICKS, lost)
        messages.append(gaps.next_message())

    update(59_000, 70, 0.0)
    for number in range(20):  # behind at another tick each time, and up to date for less than a second in between
        update(2_000 + number, 70 + number, 0.005)
        update(59_000, 70 + number, 0.8 * QUIET_S)
    update(59_000, 89, 0.3 * QUIET_S)
    assert [message for message in messages if message] == [
        "ticks are not recorded from tick 2000 on: the recorder has stopped or is too slow",
        f"ticks are recorded again after {19 * (0.8 * QUIET_S + 0.005):.1f} s; 19 ticks lost",
    ]
    update(2_000, 89, 5.0)
    slow.store(Word.RECORDER_FAILURE, errno.ENOSPC)
    update(2_000, 89, 1.0)
    assert [message and message.rpartition(": ")[2] for message in messages[-2:]] == [
        "the recorder has stopped or is too slow",
        "No space left on device",
    ]
    slow.store(Word.RECORDER_FAILURE, 0)
    update(59_000, 95, 0.5 * QUIET_S)
    update(59_000, 95, QUIET_S)
    assert messages[-2:] == [None, "ticks are recorded again after 1.0 s; 6 ticks lost"]
