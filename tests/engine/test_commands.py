"""Commands take effect in order, a few in a tick, at scheduled ticks; a tripped or stopping loop refuses some."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.engine.commands import COMMANDS_PER_TICK, QueueFull
from rtloop.engine.loop import Outcome
from rtloop.engine.memory import COMMAND_SLOTS
from rtloop.engine.messages import Kind, Origin
from rtloop.kernel.reference import Generator
from rtloop.signals import Flag, Mode
from tests.engine.harness import AXIS, CONTROLLER, IDEAL, LoopBench, text

RAW = text(IDEAL, AXIS, CONTROLLER, mode="raw")


def hold(bench: LoopBench, value: float) -> None:
    """Send a command for a constant reference."""
    bench.send(Kind.SET_REFERENCE, Generator.HOLD, value)


def test_a_bounded_number_at_a_tick_in_order():
    bench = LoopBench(RAW)
    for number in range(10):
        hold(bench, number / 10)
    rows = bench.run(5)
    events = bench.events()
    assert [event[0] for event in events] == [i // COMMANDS_PER_TICK for i in range(10)]
    assert [event[3] for event in events] == [i / 10 for i in range(10)]
    assert bench.column(rows, "x_reference_um").tolist() == [0.3, 0.7, 0.9, 0.9, 0.9]


def test_a_full_queue_says_so_and_empties():
    bench = LoopBench(RAW)
    for _ in range(COMMAND_SLOTS):
        hold(bench, 1.0)
    with pytest.raises(QueueFull, match=f"{COMMAND_SLOTS} commands wait for the loop already"):
        hold(bench, 2.0)
    bench.run(1)
    for _ in range(COMMANDS_PER_TICK):
        hold(bench, 3.0)
    assert bench.column(bench.run(COMMAND_SLOTS), "x_reference_um")[-1] == 3.0
    assert len(bench.events()) == COMMAND_SLOTS + COMMANDS_PER_TICK


def test_schedule_at_exact_ticks():
    """Entries take effect in their tick; entries of one tick in the order of the file."""
    schedule = """
        [[schedule]]
        at_tick = 700
        mode = "feedforward"
        [[schedule]]
        at_tick = 20
        reference = { kind = "hold", value = 0.5 }
        [[schedule]]
        at_tick = 20
        reference = { kind = "hold", value = 0.7 }
        [[schedule]]
        at_tick = 701
        axis = "x"
        reference = { kind = "steps", levels = [5.0, 6.0], dwell_s = 0.001 }
        [[schedule]]
        at_tick = 750
        mode = "off"
    """
    bench = LoopBench(text(IDEAL, AXIS, CONTROLLER, schedule, mode="raw"))
    rows = bench.run(800)
    reference, mode = bench.column(rows, "x_reference_um"), bench.column(rows, "mode")
    assert [(tick, kind) for tick, kind, *_ in bench.events()] == [
        (20, Kind.SET_REFERENCE),
        (20, Kind.SET_REFERENCE),
        (700, Kind.SET_MODE),
        (701, Kind.SET_REFERENCE),
        (750, Kind.SET_MODE),
    ]
    assert np.all(reference[:20] == 0.0)
    assert np.all(reference[20:701] == 0.7)
    assert np.array_equal(reference[701:], np.array([5.0, 6.0])[np.arange(99) // 10 % 2])
    assert np.all(mode[:700] == Mode.RAW)
    assert np.all(mode[700:750] == Mode.FEEDFORWARD)
    assert np.all(mode[750:] == Mode.OFF)


def test_events_name_the_origin_of_a_command():
    bench = LoopBench(RAW)
    bench.send(Kind.SET_MODE, Mode.OFF, origin=Origin.SUPERVISOR)
    bench.run(1)
    assert bench.drain("events")["origin"].tolist() == [Origin.SUPERVISOR]


def test_a_mode_is_refused_while_tripped_and_taken_after_a_reset():
    bench = LoopBench(text(IDEAL, AXIS, "[axis.interlocks]\nposition_um = 5.0\n", mode="raw"))
    hold(bench, 3.0)
    bench.run(400)
    tripped = bench.events()[-1]
    assert tripped[1:3] == (Kind.TRIPPED, Flag.TRIP_POSITION)
    bench.send(Kind.SET_MODE, Mode.FEEDFORWARD)
    rows = bench.run(300)
    assert bench.events() == [(400, Kind.REFUSED, Kind.SET_MODE, Mode.FEEDFORWARD)]
    assert np.all(bench.column(rows, "mode") == Mode.OFF)
    hold(bench, 1.0)
    bench.send(Kind.RESET_TRIP)
    bench.send(Kind.SET_MODE, Mode.RAW)
    rows = bench.run(2)
    assert bench.kinds() == [Kind.SET_REFERENCE, Kind.RESET_TRIP, Kind.SET_MODE]
    assert bench.column(rows, "mode").tolist() == [Mode.RAW, Mode.RAW]
    assert bench.column(rows, "flags").tolist() == [0, 0]


def test_into_closed_loop_the_position_in_force_is_held():
    """The change from raw mode at 3 V holds the output: the position, some 7 µm, replaces the reference in volts."""
    bench = LoopBench(text(IDEAL, AXIS, CONTROLLER, mode="raw"))
    hold(bench, 3.0)
    before = bench.run(500)
    bench.send(Kind.SET_MODE, Mode.CLOSED_LOOP, 0.0, 1.0)
    after = bench.run(10)
    position_um, command_um = (bench.column(before, f"x_{name}_um")[-1] for name in ("position", "command"))
    assert abs(position_um - command_um) > 0.01
    assert set(bench.column(after, "x_reference_um")) == {position_um}


def test_another_reference_ends_what_was_fed_with_the_one_before():
    bench = LoopBench(text(IDEAL, AXIS, CONTROLLER))
    bench.assembly.generators["feed_um"] = 3.0
    assert set(bench.column(bench.run(5), "x_feed_um")) == {3.0}
    hold(bench, 1.0)
    assert set(bench.column(bench.run(5), "x_feed_um")) == {0.0}


def test_stop_ramps_down_then_ends_and_refuses_modes_meanwhile():
    bench = LoopBench(RAW)
    hold(bench, 2.0)
    bench.run(100)
    bench.events()
    bench.send(Kind.STOP)
    first = bench.run(1)
    bench.send(Kind.SET_MODE, Mode.RAW)
    later_rows = bench.run(10_000)
    drive = np.concatenate([bench.column(first, "x_drive_v"), bench.column(later_rows, "x_drive_v")])
    assert bench.outcome is Outcome.STOPPED
    assert bench.kinds() == [Kind.STOP, Kind.REFUSED]
    np.testing.assert_allclose(drive, 2.0 - 0.1 * np.arange(1, drive.size + 1), rtol=0, atol=1e-12)
    assert drive[-1] == 0.0
