"""A command is withdrawn after its client has given up: it takes effect or is refused, never both."""

from __future__ import annotations

import os
import signal
import warnings

import pytest

from rtloop.engine.commands import QueueFull, send, withdraw
from rtloop.engine.memory import COMMAND_SLOTS, URGENT_SLOTS, Word
from rtloop.engine.messages import Kind, message
from rtloop.errors import RtloopError
from rtloop.service import desk as desk_module
from rtloop.service.desk import Desk, Refusal
from rtloop.signals import Mode
from tests.engine.harness import AXIS, CONTROLLER, IDEAL, LoopBench, text

TRIES = 3000
RAW = text(IDEAL, AXIS, CONTROLLER, mode="raw")


def hold(value: float):
    """Return the command for a constant reference."""
    return message(Kind.SET_REFERENCE, values=[0.0, value])


def test_what_was_refused_is_not_applied_when_the_loop_goes_on(monkeypatch):
    monkeypatch.setattr(desk_module, "ANSWER_TIMEOUT_S", 0.02)
    bench = LoopBench(RAW)
    bench.run(10)
    with pytest.raises(Refusal, match="did not answer within"):
        Desk(bench.block).submit(Kind.SET_REFERENCE, axis=0, values=[0.0, 3.0])
    rows = bench.run(10)
    assert bench.column(rows, "x_reference_um").tolist() == [0.0] * 10
    assert bench.events() == []


def test_what_the_loop_has_taken_is_not_called_refused(monkeypatch):
    """The loop stopped between claim and acknowledgement: the answer must not deny that the command had an effect."""
    monkeypatch.setattr(desk_module, "ANSWER_TIMEOUT_S", 0.02)
    bench = LoopBench(RAW)
    monkeypatch.setattr(desk_module, "withdraw", lambda block, position: False)
    with pytest.raises(RtloopError, match="has taken the command") as caught:
        Desk(bench.block).submit(Kind.SET_REFERENCE, axis=0, values=[0.0, 3.0])
    assert not isinstance(caught.value, Refusal)


def test_others_around_it_take_effect_in_their_order():
    bench = LoopBench(RAW)
    positions = [send(bench.block, hold(value)) for value in (1.0, 2.0, 3.0)]
    assert withdraw(bench.block, positions[1])
    assert not withdraw(bench.block, positions[1])
    bench.run(1)
    assert [event[3] for event in bench.events()] == [1.0, 3.0]
    assert not withdraw(bench.block, positions[0])


def test_exactly_one_of_loop_and_producer_gets_each_command():
    """Loop and producer claim commands at the same time, in two processes."""
    bench = LoopBench(RAW)
    bench.run(1)
    producer = os.getpid()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # about a fork in a process with threads
        pid = os.fork()
    if pid == 0:
        while os.getppid() == producer:
            bench.assembly.run(int(bench.assembly.loop.tick) + 1)
            bench.block.store(Word.RECORDER_CURSOR, bench.assembly.loop.tick)
        os._exit(0)
    withdrawn = 0
    try:
        for number in range(TRIES):
            while number - bench.block.load(Word.COMMANDS_TAIL) > COMMAND_SLOTS // 2:
                os.sched_yield()
            withdrawn += withdraw(bench.block, send(bench.block, hold(0.0)))
        while bench.block.load(Word.COMMANDS_TAIL) != TRIES:
            os.sched_yield()
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    applied = sum(event == Kind.SET_REFERENCE for event in bench.drain("events")["kind"])
    assert applied + withdrawn == TRIES
    assert withdrawn > 0


def test_a_flood_leaves_room_for_what_makes_safe():
    bench = LoopBench(RAW)
    for _ in range(COMMAND_SLOTS):
        send(bench.block, hold(1.0))
    with pytest.raises(QueueFull):
        send(bench.block, hold(1.0))
    off = message(Kind.SET_MODE, values=[float(Mode.OFF)])
    for _ in range(URGENT_SLOTS):
        send(bench.block, off, urgent=True)
    with pytest.raises(QueueFull):
        send(bench.block, off, urgent=True)
    rows = bench.run(COMMAND_SLOTS)
    assert bench.column(rows, "mode")[-1] == Mode.OFF
