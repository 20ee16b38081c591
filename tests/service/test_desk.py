"""The desk and the staging on a shared block whose words the test moves: neither confirms a change a tick early."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtloop.engine.memory import SharedBlock, Sizes
from rtloop.engine.messages import Kind, message
from rtloop.engine.ring import claim, publish
from rtloop.foundation import timing
from rtloop.service import desk as desk_module
from rtloop.service.changing.staging import Staging
from rtloop.service.desk import Desk, Refusal, RefusedByLoop, UnconfirmedCommand
from rtloop.signals import MODE, Mode


@pytest.fixture
def block() -> SharedBlock:
    """Return a shared block of 20 columns and one axis at 1 kHz."""
    return SharedBlock.create(Sizes(columns=20, axes=1, rate_hz=1000.0, snapshot_bytes=64, table_samples=0))


def test_the_words_of_the_newest_changes_are_stored(block, monkeypatch):
    monkeypatch.setattr(desk_module, "MAX_CHANGES", 2)
    monkeypatch.setattr(Desk, "_answer", lambda *_: 0)
    desk = Desk(block)
    for change in ("first", "second", "third"):
        desk.submit(Kind.LOAD_LAW, axis=0, values=[1.0], change=change)
    assert [desk.change_text(identity) for identity in range(4)] == [None, None, "second", "third"]


@pytest.mark.parametrize("stall_s", [0.0, 60.0])
def test_the_desk_answers_when_the_record_of_the_tick_is_there(block, monkeypatch, stall_s):
    """The loop publishes the event of a tick before the tick's record; until then the ring's head stays there.

    A stall of the service beyond its deadline, during which the loop answers, is no silence of the loop.
    """
    now_s = [0.0]

    def sleep(seconds: float) -> None:
        """Act as the loop: publish the event of tick 7 at the first call, and one record at each later call."""
        now_s[0] += seconds
        events = block.ring("events")
        if int(events.head[0]) == 0:
            now_s[0] += stall_s
            event = message(Kind.SET_MODE, tick=7, values=[float(Mode.OFF)])
            event["identity"] = 1
            events.slots[claim(events, np.uint64(0))] = event[0]
            publish(events, np.uint64(0))
        else:
            block["ticks_head"][0] += 1

    block["ticks_head"][0] = 7
    monkeypatch.setattr(timing, "source", timing.Source(monotonic_s=lambda: now_s[0], sleep=sleep))
    assert Desk(block).submit(Kind.SET_MODE, values=[float(Mode.OFF)]) == 7
    assert block["ticks_head"][0] == (7 if stall_s else 8)


@pytest.mark.parametrize("kind", [Kind.SET_REFERENCE, Kind.REFUSED])
def test_an_answer_that_comes_while_the_command_is_withdrawn_is_the_answer(block, monkeypatch, kind: Kind):
    """The loop claims the command after the desk's last look at the events, and before the withdrawal."""
    now_s = [0.0]

    def take_and_answer(*_: Any) -> bool:
        events, event = block.ring("events"), message(kind, tick=7)
        event["identity"] = 1
        events.slots[claim(events, np.uint64(0))] = event[0]
        publish(events, np.uint64(0))
        return False

    def sleep(seconds: float) -> None:
        now_s[0] += seconds

    monkeypatch.setattr(timing, "source", timing.Source(monotonic_s=lambda: now_s[0], sleep=sleep))
    monkeypatch.setattr(desk_module, "withdraw", take_and_answer)
    if kind is Kind.REFUSED:
        with pytest.raises(RefusedByLoop, match="refused at tick 7"):
            Desk(block).submit(Kind.SET_REFERENCE)
    else:
        assert Desk(block).submit(Kind.SET_REFERENCE) == 7


def test_a_change_that_was_taken_is_settled_two_ticks_later(block):
    """The loop takes the command after the record of tick 4: tick 5 may read the staged change; tick 6 follows."""

    class DeafDesk:
        def submit(self, *_: Any, **__: Any) -> int:
            raise UnconfirmedCommand("the loop has taken the command and stands still")

    staging = Staging(block, DeafDesk())  # type: ignore[arg-type]
    staging.require_settled()
    block["ticks_head"][0] = 5
    with pytest.raises(UnconfirmedCommand):
        staging.submit(Kind.LOAD_LAW, 0, [])
    for head in (5, 6):
        block["ticks_head"][0] = head
        with pytest.raises(Refusal, match="stands still"):
            staging.require_settled()
    block["ticks_head"][0] = 7
    staging.require_settled()
    block["ticks_head"][0] = 5
    staging.require_settled()  # a settled change is settled for good


@pytest.mark.parametrize(
    ("kind", "reason", "remedy"),
    [
        (Kind.SET_MODE, "the loop is tripped or is stopping", "rtloop ctl reset"),
        (Kind.LOAD_LAW, "the coefficients do not fit the memory of the running loop", "restart the service"),
    ],
)
def test_a_refusal_names_the_reason_for_which_the_loop_refuses_this_kind(kind: Kind, reason: str, remedy: str):
    text = str(RefusedByLoop(kind, 7))
    assert text.startswith(f"{kind.name.lower()}: refused at tick 7, because {reason}; ")
    assert remedy in text
    assert ("tripped" in text, "reset" in text) == (kind is Kind.SET_MODE, kind is Kind.SET_MODE)


@pytest.mark.parametrize("mode", [Mode.RAW, Mode.CLOSED_LOOP])
def test_raw_mode_is_that_of_the_newest_tick(block, mode: Mode):
    staging, ticks = Staging(block, SimpleNamespace()), block.ring("ticks")  # type: ignore[arg-type]
    assert not staging.in_raw_mode
    for tick, recorded_mode in enumerate((Mode.OFF, mode)):
        ticks.slots[claim(ticks, np.uint64(tick)), MODE] = recorded_mode
        publish(ticks, np.uint64(tick))
    assert staging.in_raw_mode == (mode == Mode.RAW)
