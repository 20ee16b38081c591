"""The service knows the reference that the loop holds, and a player returns to it. The loop runs in this process."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtloop.engine.commands import QueueFull
from rtloop.engine.messages import Kind
from rtloop.foundation import timing
from rtloop.kernel.reference import Generator
from rtloop.service.changing.references import LiveReferences
from rtloop.service.changing.staging import Staging
from rtloop.service.desk import Refusal, UnconfirmedCommand
from rtloop.service.measuring import player as player_module
from rtloop.service.measuring.player import Player
from rtloop.signals import FLAGS, MODE, Flag, Mode
from rtloop.supervision.supervisor import Supervisor
from tests.engine.harness import AXIS, CONTROLLER, IDEAL, LoopBench, prepare_text, text

TWO_AXES = (Path(__file__).resolve().parents[2] / "deploy" / "two-axis.toml").read_text(encoding="utf-8")
SETPOINT_UM = 5.0
SETPOINT = f'[axis.reference]\nkind = "hold"\nvalue = {SETPOINT_UM}\n'
ONE_AXIS = text(IDEAL, AXIS, CONTROLLER, SETPOINT)
SINE = {"kind": "sine", "amplitude": 0.5, "frequency_hz": 50.0}
SPARE_SAMPLES = 4096
WITHDRAWN = Refusal("set_reference: the loop did not answer within 2 s; the command is withdrawn")
UNCONFIRMED = UnconfirmedCommand("set_reference: the loop has taken the command and stands still")


class LoopDesk:
    """Desk of a loop in this process. Each command raises the next of `failures`; an unconfirmed one is executed."""

    def __init__(self, bench: LoopBench) -> None:
        self._bench, self.failures = bench, list[Exception]()
        self.before_submit: Callable[[], object] = lambda: None

    def submit(self, kind: Kind, *, axis: int = -1, values: Any = (), change: str | None = None) -> int:
        self.before_submit()
        failure = self.failures.pop(0) if self.failures else None
        if isinstance(failure, Refusal | QueueFull):
            raise failure
        tick = int(self._bench.assembly.loop.tick)
        self._bench.send(kind, *values, axis=axis)
        self._bench.run(3)
        if failure is not None:
            raise failure
        return tick


class Bench:
    """A loop in this process, its desk, and the service's view of its references."""

    def __init__(self, configuration: str = ONE_AXIS) -> None:
        prepared = prepare_text(configuration)
        self.prepared = replace(prepared, plan=replace(prepared.plan, spare_samples=SPARE_SAMPLES))
        self.loop = LoopBench(self.prepared.plan)
        self.loop.run(10)
        self.desk = LoopDesk(self.loop)
        self.references = LiveReferences(lambda: self.prepared, Staging(self.loop.block, self.desk))  # type: ignore[arg-type]

    def set_mode(self, mode: Mode, *, holds_output: bool = True) -> None:
        self.desk.submit(Kind.SET_MODE, values=[float(mode), 0.0, float(holds_output)])

    def trip(self) -> None:
        """Let the loop trip by its sensor's range, whose limits come back at once."""
        limits_v = self.loop.law.coefficients["sensor_max_v"]
        before_v, limits_v[:] = limits_v.copy(), -100.0
        self.loop.run(2)
        limits_v[:] = before_v

    def setpoint_of_loop(self, number: int = 0) -> float | None:
        """Return the constant reference (µm) in the loop's memory; None for another kind or in V."""
        generator = self.loop.assembly.generators[number]
        is_setpoint = generator["kind"] == Generator.HOLD and not generator["volts"]
        return float(generator["parameters"][0]) if is_setpoint else None

    def player(self) -> Player:
        """Return a player of axis 0 for the activity `response`."""
        supervisor: Any = SimpleNamespace(ticks=int(self.loop.block.ring("ticks").head[0]), block=self.loop.block)
        supervisor.newest = lambda count: Supervisor.newest(supervisor, count)
        live: Any = SimpleNamespace(prepared=self.prepared, references=self.references)
        return Player(supervisor, live, 0, "response")


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    """Return a bench of one axis, on which a player needs no time of rest."""
    monkeypatch.setattr(player_module, "REST_S", 0.0)
    return Bench()


def test_out_of_raw_mode_the_held_position_is_the_setpoint_and_not_the_volts(bench: Bench) -> None:
    bench.references.set("x", SINE)
    bench.set_mode(Mode.RAW)
    with pytest.raises(Refusal, match=r"reference of axis x: in V \(mode raw\); allowed: a reference in µm"):
        bench.references.constant_reference_um(0)
    bench.references.set("x", {"kind": "hold", "value": 6.0})
    bench.loop.run(2000)
    bench.set_mode(Mode.CLOSED_LOOP)
    held_um = bench.references.constant_reference_um(0)
    assert held_um == bench.setpoint_of_loop()
    assert abs(held_um - 6.0) > 1.0
    assert bench.loop.column(bench.loop.run(1), "x_reference_um")[0] == held_um
    assert bench.player().hold_um == held_um


def test_off_after_raw_mode_the_volts_are_no_setpoint(bench: Bench) -> None:
    bench.set_mode(Mode.RAW)
    bench.references.set("x", {"kind": "hold", "value": 6.0})
    bench.set_mode(Mode.OFF)
    with pytest.raises(Refusal, match=r"in V \(mode raw\)"):
        bench.references.constant_reference_um(0)


def test_a_scheduled_setpoint_is_the_held_one() -> None:
    entry = '[[schedule]]\nat_tick = 5\naxis = "x"\nreference = { kind = "hold", value = 7.5 }\n'
    assert Bench(ONE_AXIS + entry).references.constant_reference_um(0) == 7.5


@pytest.mark.parametrize("seed", range(4))
def test_the_service_knows_the_references_of_the_loop_after_any_commands(seed: int) -> None:
    """The commands are random modes, references, trips and resets on two axes; the loop's memory is the oracle."""
    bench, random, setpoints = Bench(TWO_AXES), np.random.default_rng(seed), 0
    for _ in range(150):
        action = random.choice(["mode", "setpoint", "sine", "reset", "trip"], p=[0.4, 0.4, 0.1, 0.05, 0.05])
        if action == "mode":
            bench.set_mode(Mode(int(random.integers(len(Mode)))), holds_output=random.random() < 0.8)
        elif action in ("setpoint", "sine"):
            sine = [Generator.SINE, 0.1, 20.0, 0.0, 0.0]
            values = [Generator.HOLD, random.normal()] if action == "setpoint" else sine
            bench.desk.submit(Kind.SET_REFERENCE, axis=int(random.integers(-1, 2)), values=values)
        elif action == "reset":
            bench.desk.submit(Kind.RESET_TRIP)
        else:
            bench.trip()
        for number in range(2):
            setpoint_um = bench.setpoint_of_loop(number)
            if setpoint_um is None:
                with pytest.raises(Refusal, match=r"in V \(mode raw\)|kind is (sine|table|triangle)"):
                    bench.references.constant_reference_um(number)
            else:
                setpoints += 1
                assert bench.references.constant_reference_um(number) == setpoint_um
    assert setpoints > 50


def test_after_lost_events_the_reference_is_unknown_until_mode_and_setpoint_are_set(bench: Bench) -> None:
    bench.trip()
    bench.references.follow()
    bench.desk.submit(Kind.RESET_TRIP)
    for _ in range(len(bench.loop.block.ring("events").slots) // 4 + 1):
        for _ in range(4):
            bench.loop.send(Kind.LOAD_LAW, axis=7)  # There is no such axis: the loop refuses it by an event.
        bench.loop.run(1)
    for step in (lambda: None, lambda: bench.references.set("x", {"kind": "hold", "value": 1.0}),
                 lambda: bench.set_mode(Mode.CLOSED_LOOP)):  # fmt: skip
        step()
        with pytest.raises(Refusal, match="reference of axis x: unknown, because events of the loop were lost"):
            bench.references.constant_reference_um(0)
    bench.references.set("x", {"kind": "hold", "value": 2.0})
    assert bench.references.constant_reference_um(0) == 2.0
    bench.trip()  # The reset of the first trip is among the lost events.
    bench.references.follow()
    assert bench.references.trip[:2] == (2, Mode.CLOSED_LOOP)


def test_a_trip_after_a_reset_has_neither_causes_nor_stop_of_the_first(bench: Bench) -> None:
    def newest_trip() -> tuple[Any, ...]:
        bench.references.follow()
        return (*bench.references.trip[:2], *bench.references.trip[3:])

    bench.trip()
    sensor, both = Flag.TRIP_SENSOR_RANGE, Flag.TRIP_SENSOR_RANGE | Flag.TRIP_POSITION
    assert newest_trip() == (1, Mode.CLOSED_LOOP, sensor, sensor, False)
    bench.loop.law.coefficients["position_limit_um"] = -1.0
    bench.set_mode(Mode.OFF)
    assert newest_trip() == (1, Mode.CLOSED_LOOP, sensor, both, True)
    bench.loop.law.coefficients["position_limit_um"] = 60.0
    bench.desk.submit(Kind.RESET_TRIP)
    bench.set_mode(Mode.FEEDFORWARD)
    bench.trip()
    assert newest_trip() == (2, Mode.FEEDFORWARD, sensor, sensor, False)


def test_a_setpoint_that_is_set_just_now_is_read_from_a_record_that_has_it(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The event is published before the record of its tick; if the loop then stands still, the reference is refused."""
    newest, now_s = Staging.newest_record, [0.0]
    stale = bench.references._staging.newest_record
    bench.references.set("x", {"kind": "hold", "value": 9.0})
    records = [stale, stale]
    monkeypatch.setattr(Staging, "newest_record", property(lambda s: records.pop() if records else newest.__get__(s)))
    assert (bench.references.constant_reference_um(0), records) == (9.0, [])

    def sleep(duration_s: float) -> None:
        now_s[0] += duration_s

    monkeypatch.setattr(Staging, "newest_record", stale)
    monkeypatch.setattr(timing, "source", timing.Source(monotonic_s=lambda: now_s[0], sleep=sleep))
    with pytest.raises(Refusal, match="the loop stands still after a change of the reference"):
        bench.references.constant_reference_um(0)


@pytest.mark.parametrize("failure", [WITHDRAWN, QueueFull("256 commands wait for the loop already"), UNCONFIRMED])
def test_after_a_play_that_fails_the_player_returns_to_the_setpoint(bench: Bench, failure: Exception) -> None:
    player = bench.player()
    player.play(np.full((10, 1), 6.0))
    bench.loop.run(10)
    bench.desk.failures = [failure]
    with pytest.raises(type(failure)), player.return_to_hold():
        player.play(np.full((10, 1), 7.0))
    assert bench.setpoint_of_loop() == SETPOINT_UM


def test_in_raw_mode_the_player_does_not_send_its_setpoint_as_volts(bench: Bench) -> None:
    """The mode changes during a measurement: the loop holds its drive, which 5 µm taken for 5 V would move."""
    player = bench.player()
    with player.return_to_hold():
        player.play(np.full((10, 1), 6.0))
        bench.set_mode(Mode.RAW)
    held_v = bench.loop.column(bench.loop.run(1), "x_reference_um")[0]
    drives_v = bench.loop.column(bench.loop.run(100), "x_drive_v")
    assert np.ptp(drives_v) == 0.0
    assert drives_v[0] == held_v != SETPOINT_UM
    with pytest.raises(Refusal, match="the earlier reference is in µm; references in mode raw are in V"):
        player.hold(SETPOINT_UM)


@pytest.mark.parametrize(("mode", "flag", "is_closed"), [(3, 0, True), (3, Flag.TRIP_POSITION, False), (0, 0, False)])
def test_a_tick_with_a_trip_is_not_in_closed_loop(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, mode: int, flag: int, is_closed: bool
) -> None:
    """The tick of a trip may still have the mode closed_loop."""
    player, rows = bench.player(), bench.loop.block.ring("ticks").slots[:1].copy()
    rows[:, MODE], rows[:, FLAGS] = mode, flag
    monkeypatch.setattr(Supervisor, "newest", lambda *_: rows)
    assert player.is_in_closed_loop == is_closed


def test_a_refused_reference_of_another_client_leaves_the_axis_to_the_player(bench: Bench) -> None:
    player = bench.player()
    bench.desk.failures = [WITHDRAWN]
    with pytest.raises(Refusal, match="withdrawn"):
        bench.references.set("x", {"kind": "hold", "value": 9.0})
    assert player.owns_reference
    player.play(np.full((10, 1), 6.0))


@pytest.mark.parametrize("failure", [None, UNCONFIRMED])
def test_a_player_leaves_the_reference_of_another_client_as_it_is(bench: Bench, failure: Exception | None) -> None:
    player = bench.player()
    bench.desk.failures = [] if failure is None else [failure]
    with suppress(UnconfirmedCommand):
        bench.references.set("x", {"kind": "hold", "value": 9.0})
    with pytest.raises(Refusal, match="response: another client has set a reference"), player.return_to_hold():
        player.play(np.full((10, 1), 6.0))
    assert bench.setpoint_of_loop() == 9.0


def test_a_reference_that_is_being_set_is_waited_for(bench: Bench) -> None:
    """The new reference is refused in the end, so the player has owned the axis all the time."""
    player, is_sending, may_fail = bench.player(), threading.Event(), threading.Event()
    bench.desk.before_submit, bench.desk.failures = lambda: (is_sending.set(), may_fail.wait()), [WITHDRAWN]
    refusals, answers = list[Exception](), list[bool]()

    def set_reference() -> None:
        try:
            bench.references.set("x", {"kind": "hold", "value": 9.0})
        except Refusal as refusal:
            refusals.append(refusal)

    client = threading.Thread(target=set_reference)
    client.start()
    is_sending.wait()
    measurement = threading.Thread(target=lambda: answers.append(player.owns_reference))
    measurement.start()
    measurement.join(0.2)
    may_fail.set()
    client.join()
    measurement.join()
    assert (refusals, answers) == ([WITHDRAWN], [True])


def test_samples_that_the_loop_may_play_are_not_overwritten(bench: Bench) -> None:
    """An unconfirmed waveform plays after all: the next waveform is written to the other place of the table."""
    bench.desk.failures = [UNCONFIRMED]
    with pytest.raises(UnconfirmedCommand):
        bench.references.set_waveform("x", np.full((10, 1), 6.0), 1, True)
    bench.loop.run(10)
    first = int(bench.loop.assembly.generators[0]["parameters"][0])
    samples_um: list[list[float]] = []
    bench.desk.before_submit = lambda: samples_um.append(bench.loop.block["table"][first : first + 10].tolist())
    bench.references.set_waveform("x", np.full((10, 1), 2.0), 1, True)
    assert samples_um == [[6.0] * 10]


@pytest.mark.parametrize("mode", [Mode.FEEDFORWARD, Mode.RAW, Mode.OFF])
def test_a_measurement_in_another_mode_is_refused_before_it_moves_anything(bench: Bench, mode: Mode) -> None:
    bench.loop.run(10)
    assert bench.player().hold_um == bench.setpoint_of_loop()
    bench.set_mode(mode)
    bench.loop.run(10)
    with pytest.raises(Refusal, match="response: the mode is not closed_loop") as caught:
        bench.player()
    assert ("`rtloop ctl start`" in str(caught.value)) == (mode == Mode.OFF)
    assert bench.references.set_count(0) == 0
