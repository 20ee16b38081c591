"""Policy of a recovery, with a stand-in service and loop, and a clock that the test moves."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtloop import signals
from rtloop.configuration.file import Configuration, load, parse
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.configuration.service import RecoverOptions
from rtloop.engine.memory import SharedBlock, Word
from rtloop.engine.messages import Kind
from rtloop.errors import ConfigError
from rtloop.foundation import timing
from rtloop.kernel.reference import Generator
from rtloop.recording.file.topics.recovery_steps import RecoveryStep, StepReason
from rtloop.service.changing.active_references import NO_TRIP, Trip
from rtloop.service.changing.references import Setting
from rtloop.service.desk import Desk, Refusal, Requester, use_requester
from rtloop.service.recovering import comeback
from rtloop.service.recovering.comeback import BUMP_FACTOR, RunningLoop, raised_cosine, ramp_ticks
from rtloop.service.recovering.recovery import HOUR_S, LONGEST_PAUSE_S, Recovery
from rtloop.service.recovering.soundness import unsound_reason
from rtloop.service.recovering.worker import RecoveryWorker
from rtloop.signals import Flag, Mode
from tests.laws.test_shipped import DEPLOY
from tests.service.test_after_mishap import SIZES

WAIT_S, PERIOD_S, CONFIRMATIONS = 2.0, 0.5, 3
OPTIONS = {"wait_s": WAIT_S, "confirmation_s": PERIOD_S, "confirmations": CONFIRMATIONS, "max_per_hour": 2}
PREPARED = prepare(load(DEPLOY / "paper.toml"))
TICKS_PER_STEP, STEP_S = 10, 0.125


def change_interlocks(enable_input: str | None, **limits: Any) -> Prepared:
    """Return the paper's loop with this enable input and changed interlocks."""
    configuration = PREPARED.configuration
    (axis,), loop = configuration.axes, configuration.loop.model_copy(update={"enable_input": enable_input})
    axis = axis.model_copy(update={"interlocks": axis.interlocks.model_copy(update=limits)})
    return replace(PREPARED, configuration=replace(configuration, axes=(axis,), loop=loop))


def sound_rows(count: int, first_tick: int = 0) -> Any:
    """Return records (count, columns) of a loop at rest, with safe outputs."""
    rows = np.zeros((count, len(PREPARED.plan.columns)))
    rows[:, signals.TICK] = first_tick + np.arange(count)
    rows[:, signals.axis_column(0, signals.ADC)] = 0.01
    rows[:, signals.axis_column(0, signals.POSITION)] = 0.1
    return rows


class Loop:
    """Stand-in for a loop's supervisor and live law, with references of two axes; the test determines its records and
    trips.
    """

    def __init__(self) -> None:
        self.rows: deque[Any] = deque(maxlen=1000)
        self.ticks, self.prepared, self.references = 0, PREPARED, self
        self.trip, self.client_counts, self.ended = NO_TRIP, (0, 0), False
        self.settings = [Setting((float(Generator.HOLD), value), False) for value in (20.0, 30.0)]

    def follow(self) -> None:
        pass

    def setting(self, number: int) -> Setting:
        return self.settings[number]

    def execute(self, rows: Any) -> None:
        self.rows.append(rows)
        self.ticks += len(rows)

    def newest(self, count: int) -> Any:
        return np.concatenate(list(self.rows)[-(count // TICKS_PER_STEP + 1) :])[-count:]

    def record_trip(self, *causes: Flag, mode: Mode | None = Mode.CLOSED_LOOP, tick: int = 0) -> None:
        """Begin a trip with these causes, in `mode` before it."""
        bits = sum(causes)
        self.trip = Trip(self.trip.number + 1, mode, tick, bits, bits, False)

    def add_cause(self, cause: Flag) -> None:
        """Add a cause to the present trip."""
        self.trip = self.trip._replace(causes=self.trip.causes | cause)


class Bench:
    """A service with a running loop, and its recovery; `options` replace those of OPTIONS."""

    def __init__(self, **options: Any) -> None:
        self.now_s, self.loop = 100.0, Loop()
        self.host = SimpleNamespace(supervisor=self.loop, live=self.loop, faults=[], armed=True, is_moved=False)
        self.configure(RecoverOptions(**(OPTIONS | options)))
        self.recovery = Recovery(self.host, lambda: self.now_s)  # type: ignore[arg-type]
        self.recovery.observe()

    def configure(self, options: RecoverOptions | None) -> None:
        self.host.configuration = SimpleNamespace(service=SimpleNamespace(recover=options))

    def trip(self, *causes: Flag, **more: Any) -> None:
        self.loop.record_trip(*causes, **more)
        self.recovery.observe()

    def replace_loop(self) -> None:
        self.loop = self.host.supervisor = self.host.live = Loop()
        self.recovery.observe()

    def run(self, seconds: float, change: Any = None) -> Any:
        """Execute ticks for a time, modified by `change`. Returns the confirmed return, or None if there was none."""
        for _ in range(round(seconds / STEP_S)):
            self.now_s += STEP_S
            rows = sound_rows(TICKS_PER_STEP, self.loop.ticks)
            if change is not None:
                change(rows)
            self.loop.execute(rows)
            self.recovery.observe()
            if confirmed := self.recovery.confirm(self.loop, self.loop):  # type: ignore[arg-type]
                return confirmed
        return None

    def recover(self) -> None:
        """Run until the return is confirmed, and finish the recovery."""
        confirmed = self.run(WAIT_S + (CONFIRMATIONS + 1) * PERIOD_S)
        assert confirmed is not None, self.report
        assert self.recovery.finish(confirmed.serial)

    @property
    def report(self) -> dict[str, Any]:
        report = self.recovery.for_json()
        assert report is not None
        return report

    @property
    def steps(self) -> list[tuple[RecoveryStep, StepReason]]:
        """Return all steps since the last call, each with its reason."""
        steps = []
        while (step := self.recovery.oldest_step) is not None:
            steps.append((step.step, step.reason))
            self.recovery.forget_step(step)
        return steps


def test_a_trip_from_outside_is_confirmed_as_often_as_the_policy_says():
    bench = Bench()
    bench.trip(Flag.TRIP_STALE)
    assert bench.run(WAIT_S + (CONFIRMATIONS - 0.5) * PERIOD_S) is None
    assert (bench.report["state"], bench.report["confirmed"]) == ("confirming", CONFIRMATIONS - 1)
    confirmed = bench.run(2 * PERIOD_S)
    assert confirmed.former.mode is Mode.CLOSED_LOOP
    assert [setting.values[1] for setting in confirmed.former.settings] == [20.0, 30.0]
    assert bench.report["state"] == "returning"
    assert bench.recovery.finish(confirmed.serial)
    assert (bench.report["state"], bench.report["left"]) == ("ready", 1)
    assert [step for step, _ in bench.steps] == [RecoveryStep.BEGUN, RecoveryStep.CONFIRMED, RecoveryStep.RECOVERED]


def test_one_unsound_tick_begins_the_confirmations_anew():
    bench = Bench()
    bench.trip(Flag.TRIP_STALE)
    assert bench.run(WAIT_S + 2.5 * PERIOD_S) is None
    assert bench.report["confirmed"] == 2

    def spoil(rows: Any) -> None:
        rows[7, signals.SAMPLE_AGE] = np.inf

    assert bench.run(STEP_S, spoil) is None
    assert bench.run(PERIOD_S) is None
    assert bench.report["confirmed"] == 0
    assert (RecoveryStep.UNSOUND, StepReason.AGE) in bench.steps
    assert bench.run((CONFIRMATIONS - 1) * PERIOD_S) is None
    assert bench.run(2 * PERIOD_S) is not None


def test_ticks_that_were_not_seen_are_not_sound():
    bench = Bench()
    bench.trip(Flag.TRIP_STALE)
    bench.run(WAIT_S + STEP_S)
    bench.loop.newest = lambda count: sound_rows(count // 2, bench.loop.ticks - count // 2)  # type: ignore[method-assign]
    bench.run(2 * PERIOD_S)
    assert (bench.report["confirmed"], bench.steps[-1][1]) == (0, StepReason.NO_TICKS)


def test_unsound_readings_are_reported_now_and_then():
    bench = Bench()
    bench.trip(Flag.TRIP_STALE)

    def spoil(rows: Any) -> None:
        rows[:, signals.DRIVER_STATUS] = 1

    bench.run(60.0, spoil)
    assert 5 <= sum(step is RecoveryStep.UNSOUND for step, _ in bench.steps) <= 7
    assert bench.report["state"] == "confirming"

    def spoil_otherwise(rows: Any) -> None:
        rows[:, signals.SAMPLE_AGE] = np.inf

    bench.run(2 * PERIOD_S, spoil_otherwise)  # Another reason is reported at once.
    assert bench.steps == [(RecoveryStep.UNSOUND, StepReason.AGE)]


@pytest.mark.parametrize("cause", [flag for flag in Flag if flag & signals.TRIP_MASK])
@pytest.mark.parametrize("allowed", ["stale", "driver", "late", "heartbeat"])
def test_a_trip_is_recovered_only_where_its_cause_is_allowed(cause, allowed):
    bench = Bench(causes=(allowed,))
    bench.trip(cause)
    is_allowed = signals.trip_causes(cause) == [allowed]
    assert bench.report["state"] == ("waiting" if is_allowed else "latched")
    assert (bench.run(60.0) is not None) == is_allowed


@pytest.mark.parametrize("causes", [(Flag.TRIP_STALE, Flag.TRIP_POSITION), (Flag.TRIP_LATE, Flag.TRIP_FROZEN)])
def test_every_cause_of_a_trip_must_be_allowed(causes):
    bench = Bench()
    bench.trip(*causes)
    assert bench.report["state"] == "latched"


@pytest.mark.parametrize(
    ("first", "follower", "state"),
    [
        (Flag.TRIP_STALE, Flag.TRIP_FROZEN, "waiting"),
        (Flag.TRIP_DRIVER, Flag.TRIP_FROZEN, "waiting"),
        (Flag.TRIP_LATE, Flag.TRIP_FROZEN, "latched"),
        (Flag.TRIP_STALE, Flag.TRIP_SENSOR_RANGE, "latched"),
        (Flag.TRIP_STALE, Flag.TRIP_ENABLE, "latched"),
    ],
)
def test_a_cause_that_follows_latches_unless_missing_samples_explain_it(first, follower, state):
    bench = Bench()
    bench.trip(first)
    bench.loop.add_cause(follower)
    bench.run(0.5)
    assert bench.report["state"] == state


def test_after_its_number_within_an_hour_a_trip_stays_latched():
    bench = Bench()
    for _ in range(2):
        bench.trip(Flag.TRIP_STALE)
        bench.recover()
    bench.trip(Flag.TRIP_STALE)
    assert bench.report["state"] == "latched"
    assert "max_per_hour" in bench.report["reason"]
    assert bench.run(100.0) is None
    bench.recovery.clear()
    bench.trip(Flag.TRIP_STALE)  # A reset gives no further recovery; the hour does.
    assert bench.report["state"] == "latched"
    bench.recovery.clear()
    bench.now_s += HOUR_S
    assert bench.report["left"] == 2
    bench.trip(Flag.TRIP_STALE)
    bench.recover()


def test_a_trip_in_the_middle_counts_and_keeps_the_state_before_the_first():
    bench = Bench()
    bench.trip(Flag.TRIP_STALE, mode=Mode.FEEDFORWARD)
    confirmed = bench.run(10.0)
    bench.trip(Flag.TRIP_LATE, mode=Mode.RAW)  # during a depolarisation
    assert not bench.recovery.is_current(confirmed.serial)
    assert not bench.recovery.finish(confirmed.serial)
    assert (bench.report["state"], bench.report["left"]) == ("waiting", 0)
    assert bench.run(10.0).former.mode is Mode.FEEDFORWARD


def test_a_trip_that_comes_to_light_at_the_end_of_a_return_begins_another_recovery():
    bench = Bench()
    bench.trip(Flag.TRIP_STALE)
    confirmed = bench.run(10.0)
    bench.loop.follow = lambda: bench.loop.record_trip(Flag.TRIP_LATE)  # type: ignore[method-assign]
    assert not bench.recovery.finish(confirmed.serial)
    bench.recovery.observe()
    assert (bench.report["state"], bench.report["left"]) == ("waiting", 0)


def test_another_failure_of_the_driver_before_the_return_counts():
    bench = Bench()
    bench.trip(Flag.TRIP_DRIVER)
    bench.replace_loop()
    bench.trip(Flag.TRIP_DRIVER, mode=Mode.OFF)
    assert (bench.report["state"], bench.report["left"]) == ("waiting", 0)
    bench.replace_loop()
    bench.trip(Flag.TRIP_DRIVER, mode=Mode.OFF)
    assert bench.report["state"] == "latched"


def test_confirmations_of_a_loop_that_ended_do_not_count_for_the_next():
    bench = Bench()
    bench.trip(Flag.TRIP_DRIVER)
    bench.run(WAIT_S + 2.5 * PERIOD_S)
    bench.replace_loop()
    assert bench.run(2.5 * PERIOD_S) is None
    assert bench.run(2.0 * PERIOD_S) is not None


def test_a_trip_in_mode_off_begins_nothing():
    bench = Bench()
    bench.trip(Flag.TRIP_STALE, mode=Mode.OFF)
    assert bench.run(60.0) is None
    assert bench.report["state"] == "ready"


def test_a_client_that_takes_over_ends_it():
    bench = Bench()
    bench.trip(Flag.TRIP_STALE)
    bench.run(WAIT_S + PERIOD_S)
    bench.recovery.end()
    assert bench.report["state"] == "latched"
    assert bench.run(60.0) is None
    bench.recovery.clear()
    bench.trip(Flag.TRIP_STALE)
    confirmed = bench.run(10.0)
    bench.recovery.end()
    assert not bench.recovery.is_current(confirmed.serial)
    assert not bench.recovery.finish(confirmed.serial)


def test_no_command_of_an_ended_recovery_reaches_the_loop():
    """A client sends a stop after the last confirmation and before the first command of the return."""
    bench, block = Bench(), SharedBlock.create(SIZES)
    bench.trip(Flag.TRIP_STALE)
    confirmed = bench.run(10.0)
    bench.recovery.end()
    assert bench.steps
    worker = RecoveryWorker(bench.host, bench.recovery)  # type: ignore[arg-type]
    worker._return(RunningLoop(bench.loop, bench.loop, Desk(block)), confirmed)  # type: ignore[arg-type]
    assert block.load(Word.COMMANDS_HEAD) == 0
    assert bench.host.faults == []


@pytest.mark.parametrize("command", [(Kind.RESET_TRIP, ()), (Kind.SET_MODE, (0.0,)), (Kind.SET_MODE, (3.0,))])
def test_a_recovery_without_permission_may_send_nothing(command):
    """A client may always send a stop and a reset; a recovery needs permission for them."""

    def refuse() -> None:
        raise Refusal("ended")

    kind, values = command
    block = SharedBlock.create(SIZES)
    with (
        use_requester(Requester(require_permission=refuse, may_always_stop=False)),
        pytest.raises(Refusal, match="ended"),
    ):
        Desk(block).submit(kind, values=values)
    assert block.load(Word.COMMANDS_HEAD) == 0


def test_a_stop_that_came_before_the_service_saw_the_trip_ends_it():
    bench = Bench()
    bench.loop.record_trip(Flag.TRIP_STALE)
    bench.loop.trip = bench.loop.trip._replace(is_stopped=True)
    bench.recovery.observe()
    assert bench.run(60.0) is None
    assert bench.report["reason"] == "a client's command"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"armed": False}, "armed"),
        ({"is_moved": True}, "measurement"),
        ({"faults": ["second opinion: another loop"]}, "fault"),
    ],
)
def test_a_service_that_may_not_drive_does_not_return(change, reason):
    bench = Bench()
    bench.trip(Flag.TRIP_STALE)
    vars(bench.host).update(change)
    assert bench.run(60.0) is None
    assert reason in bench.report["reason"]


def test_another_law_is_not_returned_to():
    bench = Bench()
    bench.trip(Flag.TRIP_STALE)
    bench.loop.prepared = change_interlocks(None, position_um=59.0)
    assert bench.run(60.0) is None
    assert "changed" in bench.report["reason"]


def test_a_reference_in_another_unit_is_not_returned_to():
    bench = Bench()
    bench.trip(Flag.TRIP_STALE, mode=Mode.RAW)  # the reference is in µm
    assert bench.run(60.0) is None
    assert "reference" in bench.report["reason"]


@pytest.mark.parametrize("number", [0, 1])
def test_a_setpoint_of_a_client_while_tripped_is_returned_to(number: int):
    bench, values, counts = Bench(), [20.0, 30.0], [0, 0]
    bench.trip(Flag.TRIP_STALE)
    bench.run(WAIT_S)
    values[number], counts[number] = 5.0, 1
    bench.loop.settings[number] = Setting((float(Generator.HOLD), 5.0), False)
    bench.loop.client_counts = (counts[0], counts[1])
    assert [setting.values[1] for setting in bench.run(10.0).former.settings] == values


@pytest.mark.parametrize("number", [0, 1])
def test_a_configured_table_that_was_changed_is_not_returned_to(number: int):
    bench = Bench()
    bench.loop.settings[number] = Setting((float(Generator.TABLE), 0.0, 4.0, 1.0, 1.0, 0.0), False)
    bench.trip(Flag.TRIP_STALE)
    bench.loop.prepared = replace(PREPARED, plan=replace(PREPARED.plan, table=np.ones(4)))
    assert bench.run(60.0) is None
    assert "changed" in bench.report["reason"]


def test_a_policy_that_is_removed_ends_it():
    bench = Bench()
    bench.trip(Flag.TRIP_STALE)
    bench.configure(None)
    bench.run(60.0)
    assert bench.recovery.for_json() is None
    assert bench.steps[-1] == (RecoveryStep.ENDED, StepReason.CHANGED)


def test_only_the_end_of_a_loop_by_an_allowed_cause_is_covered():
    bench = Bench()
    assert bench.recovery.accept_end("driver_failed", "the card is gone")
    assert not bench.recovery.accept_end("heartbeat_lost", "the service slept")
    for outcome in ("killed", "law_failed", "failed", "done", "stopped"):
        assert not bench.recovery.accept_end(outcome, outcome)
    bench.host.faults += ["the card is gone", "another"]
    bench.recovery.remove_own_faults(serial=0)
    assert bench.host.faults == ["the card is gone", "another"]
    bench.recovery.remove_own_faults(serial=1)  # The loops that ended otherwise have latched it.
    assert bench.host.faults == ["another"]
    bench.host.faults += ["the card is gone"]  # This end is not accepted, although an equal one was.
    bench.recovery.remove_own_faults(serial=1)
    assert bench.host.faults == ["another", "the card is gone"]
    assert bench.recovery.accept_end("driver_failed", "the card is gone")
    bench.recovery.clear()
    bench.recovery.remove_own_faults(serial=1)
    assert bench.host.faults == ["another", "the card is gone"]


def test_the_first_loop_of_a_service_must_start():
    bench = Bench()
    assert bench.recovery.accept_failed_start("no answer")
    assert not Recovery(bench.host).accept_failed_start("no answer")  # type: ignore[arg-type]


def test_the_pause_between_starts_doubles_up_to_a_limit():
    bench, pauses_s = Bench(), []
    for _ in range(20):
        bench.recovery.accept_failed_start("no answer")
        pauses_s.append(bench.recovery.pause_s)
    assert pauses_s[:3] == [WAIT_S, 2 * WAIT_S, 4 * WAIT_S]
    assert pauses_s[-1] == LONGEST_PAUSE_S
    for end in (bench.recovery.clear, lambda: (bench.trip(Flag.TRIP_STALE), bench.recover())):
        end()
        bench.recovery.accept_failed_start("no answer")
        assert bench.recovery.pause_s == WAIT_S


AXIS = {name: signals.axis_column(0, column) for name, column in
        (("adc", signals.ADC), ("position", signals.POSITION), ("drive", signals.DRIVE))}  # fmt: skip


@pytest.mark.parametrize(
    ("column", "value", "reason"),
    [
        (signals.DRIVER_STATUS, 1.0, StepReason.DRIVER),
        (signals.DRIVER_STATUS, -5.0, StepReason.DRIVER),
        (signals.SAMPLE_AGE, 1000.1, StepReason.AGE),
        (signals.SAMPLE_AGE, np.nan, StepReason.AGE),
        (signals.TICK, 900.0, StepReason.NO_TICKS),
        (signals.MODE, 1.0, StepReason.OUTPUTS),
        (signals.FLAGS, float(Flag.RAMPING), StepReason.OUTPUTS),
        (signals.FLAGS, float(Flag.WRITE_FAILED), StepReason.OUTPUTS),
        (AXIS["drive"], 0.01, StepReason.OUTPUTS),
        (AXIS["adc"], 9.99, StepReason.SENSOR),
        (AXIS["adc"], -9.985, StepReason.SENSOR),
        (AXIS["adc"], np.nan, StepReason.SENSOR),
        (AXIS["position"], 60.1, StepReason.POSITION),
        (AXIS["position"], np.nan, StepReason.POSITION),
        (signals.FLAGS, float(Flag.TRIP_STALE | Flag.OVERRUN), None),
        (signals.SAMPLE_AGE, 999.9, None),
        (AXIS["adc"], 9.97, None),
        (signals.LATENESS, 1e6, None),
    ],
)
def test_a_reading_is_sound_within_the_limits_of_the_interlocks(column, value, reason):
    rows = sound_rows(10)
    rows[5, column] = value
    assert unsound_reason(rows, change_interlocks(None, late_ticks=0, sample_age_us=1000.0)) is reason


@pytest.mark.parametrize("number", [0, 1])
def test_the_reading_of_each_axis_must_be_sound(number: int):
    prepared = prepare(load(DEPLOY / "two-axis.toml"))
    rows = np.zeros((10, len(prepared.plan.columns)))
    rows[:, signals.TICK] = np.arange(10)
    assert unsound_reason(rows, prepared) is None
    rows[5, signals.axis_column(number, signals.ADC)] = np.nan
    assert unsound_reason(rows, prepared) is StepReason.SENSOR


@pytest.mark.parametrize(
    ("column", "value", "reason"),
    [(signals.ENABLE, 2.4, StepReason.ENABLE), (signals.LATENESS, 501.0, StepReason.LATENESS),
     (signals.LATENESS, 499.0, None)],
)  # fmt: skip
def test_enable_and_lateness_are_judged_where_they_are_set(column, value, reason):
    prepared = change_interlocks("adc0", late_ticks=2, late_us=500.0)
    rows = sound_rows(10)
    rows[:, signals.ENABLE] = 5.0
    assert unsound_reason(rows, prepared) is None
    rows[5, column] = value
    assert unsound_reason(rows, prepared) is reason


def test_the_ramp_of_a_return_is_smooth_and_slow_enough():
    """The steepest slope of the cosine is pi/2 of the mean slope: at most a sixth of the trip's slew rate, for a drive
    from the end of its range."""
    ticks, limits = ramp_ticks(SimpleNamespace(prepared=PREPARED)), PREPARED.configuration.axes[0].limits  # type: ignore[arg-type]
    samples = raised_cosine(-limits.drive_v, 0.0, ticks)
    steepest_v_per_s = np.max(np.abs(np.diff(samples))) * PREPARED.plan.pacing.rate_hz
    assert steepest_v_per_s <= limits.trip_slew_v_per_s / 6.0
    assert (samples[0], samples[-1]) == (-limits.drive_v, 0.0)
    assert samples[1] - samples[0] < 1e-3 * np.max(np.diff(samples)) * 10
    assert ticks >= BUMP_FACTOR * limits.bump_s * PREPARED.plan.pacing.rate_hz


@pytest.mark.parametrize("order", [1, -1])
def test_the_slowest_axis_determines_the_ramp_of_a_return(order: int):
    (axis,), plan = PREPARED.configuration.axes, PREPARED.plan
    slow = axis.model_copy(update={"limits": axis.limits.model_copy(update={"trip_slew_v_per_s": 2.0})})
    configuration = SimpleNamespace(axes=(axis, slow)[::order])
    pair = SimpleNamespace(coefficients=np.concatenate([plan.coefficients] * 2), pacing=plan.pacing)
    live: Any = SimpleNamespace(prepared=SimpleNamespace(configuration=configuration, plan=pair))
    travel_s = axis.limits.drive_v / 2.0
    assert ramp_ticks(live) == round(10.0 * travel_s * plan.pacing.rate_hz)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ('causes = ["stale", "position"]', "'position': must be 'stale', 'driver', 'late' or 'heartbeat'"),
        ("depolarise = true", r"recover.depolarise: true; add the table \[service.depolarise\]"),
        ("max_per_hour = 0", "max_per_hour: 0: must be greater than or equal to 1"),
    ],
)
def test_a_policy_that_cannot_be_is_refused(keys, message):
    text = (DEPLOY / "paper.toml").read_text() + f"\n[service.recover]\n{keys}\n"
    with pytest.raises(ConfigError, match=message):
        parse(text, "paper", DEPLOY, "paper.toml")


def test_recovery_is_off_by_default():
    configuration: Configuration = PREPARED.configuration
    assert configuration.service.recover is None


def test_a_record_that_came_while_the_service_stalled_is_found(monkeypatch):
    """The first pause ends long after the deadline."""
    now_s, rows = [0.0], np.zeros((0, 10))

    def sleep(_: float) -> None:
        nonlocal rows
        now_s[0] += 60.0
        rows = np.full((1, 10), 7.0)

    supervisor: Any = SimpleNamespace(newest=lambda _: rows, ticks=8)
    monkeypatch.setattr(timing, "source", timing.Source(monotonic_s=lambda: now_s[0], sleep=sleep))
    assert comeback._await_record(supervisor, 7)[0] == 7.0
