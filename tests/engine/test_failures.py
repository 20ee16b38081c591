"""Trips, failing drivers and a lost heartbeat: each ends in a ramp to the safe value and an event."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtloop.drivers.playback import Playback
from rtloop.engine import in_process, process
from rtloop.engine.loop import Outcome
from rtloop.engine.memory import Word
from rtloop.engine.messages import Kind, Origin, message
from rtloop.engine.plan import Pacing
from rtloop.errors import ConfigError
from rtloop.recording.file.topics.events import trip_reason
from rtloop.signals import Flag, Mode
from tests.drivers.bench_driver import LoopBack
from tests.engine.failing_driver import ScriptedDriver
from tests.engine.harness import AXIS, CONTROLLER, FOR_EVER, IDEAL, LoopBench, ScriptedClock, make_plan, text

RAW = text(IDEAL, AXIS, '[axis.reference]\nkind = "hold"\nvalue = 3.0\n', mode="raw")
RAMP = 3.0 - 0.1 * np.arange(1, 31)
"""Drive (V) of each tick of a ramp from 3 V, by the trip's 1000 V/s at 10 kHz."""


def fail_at_40(tick: int) -> float:
    """Return a reading of 0.1 V; raise OSError in tick 40."""
    if tick == 40:
        raise OSError("the cable is out")
    return 0.1


class RefusingLoop:
    """A loop run to its end on a card that refuses the writes, numbered from 1, for which `is_refused` is True."""

    def __init__(self, is_refused: Callable[[int], bool]) -> None:
        self.tries = 0
        self.driver = ScriptedDriver(lambda k: 0.0, self._refuse)
        self.bench = LoopBench(RAW, self.driver)
        self._is_refused = is_refused
        self.rows = self.bench.run(FOR_EVER)
        assert self.bench.outcome is Outcome.DRIVER_FAILED
        self.failed = self.bench.column(self.rows, "flags").astype(int) & Flag.WRITE_FAILED != 0

    def _refuse(self, _: int) -> None:
        self.tries += 1
        if self._is_refused(self.tries):
            raise OSError("no such device")


def test_stop_word_parks():
    bench = LoopBench(RAW)
    bench.run(100)
    assert bench.block["last_drive_v"].tolist() == [3.0]
    bench.block.store(Word.STOP, 1)
    rows = bench.run(FOR_EVER)
    assert bench.outcome is Outcome.STOPPED
    np.testing.assert_allclose(bench.column(rows, "x_drive_v"), RAMP, rtol=0, atol=1e-12)
    assert bench.column(rows, "x_drive_v")[-1] == 0.0
    assert np.all(bench.column(rows, "mode") == Mode.OFF)
    assert bench.block["last_drive_v"][0] == 0.0


def test_a_stop_names_who_stopped():
    """The origin of a stop is the supervisor, or the loop after a write that failed."""
    bench = LoopBench(RAW)
    bench.run(10)
    bench.drain("events")
    bench.block.store(Word.STOP, 1)
    bench.run(FOR_EVER)
    origins = [(Kind(int(event["kind"])), Origin(int(event["origin"]))) for event in bench.drain("events")]
    assert origins == [(Kind.STOP, Origin.SUPERVISOR)]
    loop = RefusingLoop(lambda number: number == 26)
    events = loop.bench.drain("events")
    assert [(Kind(int(event["kind"])), Origin(int(event["origin"]))) for event in events] == [
        (Kind.DRIVER_FAILED, Origin.LOOP), (Kind.STOP, Origin.LOOP)
    ]  # fmt: skip


def test_ticks_after_the_limit_are_run_but_not_recorded():
    plan = LoopBench(RAW).plan
    bench = LoopBench(replace(plan, ticks=50))
    assert bench.run(50).shape[0] == 50
    bench.block.store(Word.STOP, 1)
    assert bench.run(FOR_EVER).shape[0] == 0
    assert bench.outcome is Outcome.STOPPED
    assert bench.block["last_drive_v"][0] == 0.0


def test_a_read_that_fails_is_ramped_down_and_ends_the_run():
    driver = ScriptedDriver(fail_at_40)
    bench = LoopBench(RAW, driver)
    rows = bench.run(FOR_EVER)
    assert bench.outcome is Outcome.DRIVER_FAILED
    assert bench.column(rows, "driver_status")[40] == -1
    assert bench.events() == [
        (40, Kind.TRIPPED, Flag.TRIP_DRIVER, 0.0),
        (40, Kind.DRIVER_FAILED, -1.0, 0.0),
    ]
    drive = bench.column(rows, "x_drive_v")
    assert np.all(drive[:40] == 3.0)
    np.testing.assert_allclose(drive[40:], RAMP, rtol=0, atol=1e-12)
    assert driver.written == drive.tolist()
    assert str(driver.error) == "the cable is out"


@pytest.mark.parametrize("for_good", [False, True])
def test_a_write_that_fails_is_ramped_down_by_further_writes(for_good: bool):
    """The ramp reaches 0 V on a card that refuses one value, and is tried for a second on a card that refuses all."""
    loop = RefusingLoop(lambda number: number == 26 or (for_good and number > 26))
    drive = loop.bench.column(loop.rows, "x_drive_v")
    assert np.all(drive[:26] == 3.0)  # the tick that failed is recorded
    if for_good:  # the later ticks too; after a second of refused writes the loop gives up
        assert np.all(drive == 3.0)
        assert len(drive) == 25 + 10_001
    else:
        np.testing.assert_allclose(drive[26:], RAMP, rtol=0, atol=1e-12)
    assert np.array_equal(loop.failed, np.arange(len(drive)) >= 25 if for_good else np.arange(len(drive)) == 25)
    assert loop.driver.written == drive[~loop.failed].tolist()
    assert loop.tries == len(drive)
    assert loop.bench.events() == [(25, Kind.DRIVER_FAILED, -1.0, 1.0), (26, Kind.STOP, 0.0, 0.0)]
    assert str(loop.driver.error) == "no such device"


@pytest.mark.parametrize("refused_count", [1, 2, 20, 200])
def test_a_card_that_refuses_for_a_while_is_not_stepped(refused_count: int):
    """The ramp continues from the last accepted value: each accepted value is one step further."""
    loop = RefusingLoop(lambda number: 26 <= number < 26 + refused_count)
    assert np.abs(np.diff([3.0, *loop.driver.written])).max() <= 0.1 + 1e-12
    assert loop.driver.written[-1] == 0.0
    assert np.count_nonzero(loop.failed) == refused_count


def test_a_card_that_refuses_most_values_is_still_ramped_down():
    """The card accepts one of 401 values: it refuses for more than a second in all, but never for a second in a row."""
    loop = RefusingLoop(lambda number: number > 25 and number % 401 != 0)
    assert loop.tries > 10_000
    assert loop.driver.written[-1] == 0.0


def test_a_nan_from_the_driver_holds_then_ramps():
    bench = LoopBench(RAW, ScriptedDriver(lambda k: math.nan if k == 10 else 0.1))
    rows = bench.run(100)
    drive = bench.column(rows, "x_drive_v")
    assert drive[10] == 3.0
    np.testing.assert_allclose(drive[11:41], RAMP, rtol=0, atol=1e-12)
    assert np.all(drive[41:] == 0.0)
    ((*event, value_v),) = bench.events()
    assert (event, math.isnan(value_v)) == ([10, Kind.TRIPPED, Flag.TRIP_NON_FINITE], True)


def test_a_wait_that_fails_ends_the_run():
    bench = LoopBench(RAW, clock=ScriptedClock(np.zeros((7, 4))))
    assert bench.run(FOR_EVER).shape[0] == 7
    assert bench.outcome is Outcome.DRIVER_FAILED


def test_a_lost_heartbeat_parks():
    """The last heartbeat was at 5 s; the timeout of 1 s ends at 6 s."""
    ticks = np.arange(200)
    monotonic_ns = 6e9 + (ticks - 100) * 1e5
    grid = ticks * 1e5
    bench = LoopBench(RAW, clock=ScriptedClock(np.column_stack([grid, grid, 0 * grid, monotonic_ns])))
    bench.block.store(Word.HEARTBEAT_NS, 5_000_000_000)
    rows = bench.run(FOR_EVER)
    assert bench.outcome is Outcome.HEARTBEAT_LOST
    flags = bench.column(rows, "flags").astype(int)
    assert np.all(flags[:101] == 0)
    assert np.all(
        flags[101:] & (Flag.TRIP_HEARTBEAT | Flag.HEARTBEAT_LOST) == Flag.TRIP_HEARTBEAT | Flag.HEARTBEAT_LOST
    )
    np.testing.assert_allclose(bench.column(rows, "x_drive_v")[101:], RAMP, rtol=0, atol=1e-12)
    assert bench.events() == [(101, Kind.TRIPPED, Flag.TRIP_HEARTBEAT, pytest.approx(1.0001))]


def test_the_trip_of_a_lost_heartbeat_tells_its_reason():
    clock = ScriptedClock(np.column_stack([np.zeros((9, 3)), np.full(9, 9e9)]))
    bench = LoopBench(RAW, clock=clock)
    bench.block.store(Word.HEARTBEAT_NS, 5_000_000_000)
    bench.run(3)
    (event,) = bench.trips()
    assert (event["axis"], event["what"]["causes"]) == (None, ["heartbeat"])
    assert event["what"]["reason"] == (
        "the heartbeat of `rtloop run` or of the service stopped for 4 s: that process died or stood still"
    )


def test_the_trip_of_a_lost_heartbeat_in_an_older_recording_tells_its_reason():
    """Its event has the causes alone."""
    event = message(Kind.TRIPPED, values=[Flag.TRIP_HEARTBEAT])
    assert trip_reason(event[0], ["x"], []) == (
        "the heartbeat of `rtloop run` or of the service stopped: that process died or stood still"
    )


@pytest.mark.parametrize(("status", "tripped"), [(2, False), (-7, True)])
def test_a_status_above_zero_is_recorded_and_no_trip(status, tripped):
    tape = Playback()
    tape.load(np.column_stack([np.zeros((50, 4)), np.full(50, status), np.zeros((50, 4))]))
    driver = ScriptedDriver(lambda k: 0.0)
    driver.open = tape.pointers  # type: ignore[method-assign]
    bench = LoopBench(RAW, driver)
    rows = bench.run(20)
    assert np.all(bench.column(rows, "driver_status") == status)
    assert bool(int(bench.column(rows, "flags")[0]) & Flag.TRIP_DRIVER) is tripped


def refuse_options() -> LoopBack:
    """Raise ValueError, as a driver does for a wrong option."""
    raise ValueError("device: '/dev/none'; allowed: /dev/card0")


@pytest.mark.parametrize(
    ("driver", "pacing", "fault"),
    [
        (LoopBack, Pacing(2001.0), "loop.rate_hz: 2001 Hz; allowed with driver 'loopback': at most 2000 Hz"),
        (
            LoopBack,
            Pacing(1000.0, paced=False),
            "driver 'loopback' moves real hardware and cannot run in virtual time; leave out --unpaced",
        ),
        (refuse_options, Pacing(1000.0), "driver.device: '/dev/none'; allowed: /dev/card0"),
    ],
)
def test_a_fault_of_the_plan_begins_with_its_own_key(driver: Callable[[], LoopBack], pacing: Pacing, fault: str):
    plan: Any = SimpleNamespace(name="lab", driver=driver, pacing=pacing)
    with pytest.raises(ConfigError) as caught:
        process._make_driver(plan)
    assert caught.value.faults == [fault]


def test_a_loop_in_process_that_ends_early_gives_its_ticks_once(monkeypatch: pytest.MonkeyPatch):
    """The ring has room for 4096 ticks; the loop ends after 5000 of 20,000."""
    plan = make_plan(text(AXIS, CONTROLLER, IDEAL))
    blocks: list[tuple[int, int]] = []

    class EarlyEndingAssembly(in_process.Assembly):
        def run(self, tick: int) -> None:
            super().run(min(tick, 5_000))

    monkeypatch.setattr(in_process, "Assembly", EarlyEndingAssembly)
    ticks = in_process.LoopsInProcess().run(plan, plan.driver(), 20_000, lambda n, rows: blocks.append((n, len(rows))))
    assert (ticks, blocks) == (5_000, [(0, 4_096), (4_096, 904)])
