"""Triggers find the sweeps of a reference in plain Python, and the known trigger ticks of synthetic recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtloop.client.capture.conditions import Condition, Edge, Late, ModeChanged, Slope, Stepped, Tripped, Window
from rtloop.client.capture.trigger import Cause, Mode, Settings, Sweep, Trigger
from rtloop.client.ticks.tick_stretch import Stretch
from tests.client.oracle import ConditionSpec, expected_sweeps

COLUMNS = ("flags", "mode", "periods_missed", "s")
CONDITIONS: dict[str, Callable[[ConditionSpec], Condition]] = {
    "edge": lambda spec: Edge("s", spec.level, Slope(spec.slope), spec.hysteresis),
    "window": lambda spec: Window("s", spec.low, spec.high),
    "trip": lambda spec: Tripped(),
    "mode": lambda spec: ModeChanged(),
    "late": lambda spec: Late(),
    "step": lambda spec: Stepped("s", spec.threshold),
}
VALUES = st.sampled_from([-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, np.nan, np.inf])
RECORDS = st.tuples(st.sampled_from([0.0, 1.0, 256.0, 768.0, 8192.0]), st.sampled_from([0.0, 3.0]),
                    st.sampled_from([0.0, 0.0, 2.0]), VALUES)  # fmt: skip
LEVELS = st.sampled_from([-1.0, 0.0, 0.5])
SPECS = st.builds(
    ConditionSpec,
    kind=st.sampled_from(sorted(CONDITIONS)),
    level=LEVELS,
    slope=st.sampled_from(["rising", "falling", "either"]),
    hysteresis=st.sampled_from([0.0, 0.5, 1.0]),
    low=LEVELS,
    high=st.sampled_from([0.75, 1.0]),
    threshold=st.sampled_from([0.0, 1.0]),
)
SETTINGS = st.builds(
    Settings,
    ticks=st.integers(1, 12),
    mode=st.sampled_from(Mode),
    pre_percent=st.sampled_from([0.0, 30.0, 100.0]),
    holdoff_ticks=st.integers(0, 15),
    auto_ticks=st.integers(1, 20),
)


def split_rows(first: int, rows: np.ndarray, ends: list[int], run: int = 0) -> Iterator[Stretch]:
    """Yield consecutive stretches of `rows` that end at the row indices `ends`; the last one ends with the rows."""
    for begin, end in zip([0, *ends], [*ends, len(rows)], strict=True):
        yield Stretch(COLUMNS, first + begin, rows[begin:end], 0, run)


def sweep_figures(sweep: Sweep) -> tuple:
    """Return (first, trigger, end, cause, uncertain ticks) of a sweep, as the reference does."""
    return sweep.first, sweep.trigger, sweep.end, str(sweep.cause), sweep.uncertain_ticks


@given(SPECS, SETTINGS, st.lists(RECORDS, min_size=1, max_size=80), st.data())
@settings(max_examples=300)
def test_sweeps_are_those_of_a_scope_that_sees_tick_by_tick(
    spec: ConditionSpec, trigger_settings: Settings, records: list, data: st.DataObject
):
    """The records come in stretches of any length, with any number of lost ticks between them."""
    ends = sorted(data.draw(st.sets(st.integers(0, len(records)), max_size=6)))
    lost = data.draw(st.lists(st.integers(0, 4), min_size=len(ends) + 1, max_size=len(ends) + 1))
    forced = data.draw(st.integers(0, len(ends)))
    trigger = Trigger(trigger_settings, lambda: CONDITIONS[spec.kind](spec))
    first, fed_records, sweeps, force_at = 7, {}, [], None
    for number, stretch in enumerate(split_rows(0, np.array(records), ends)):
        if number == forced:
            trigger.force()
        first += lost[number] if number else 0
        if number >= forced and force_at is None and len(stretch):
            force_at = first
        sweeps += trigger.feed(Stretch(COLUMNS, first, stretch.rows, lost[number]))
        fed_records |= {first + k: dict(zip(COLUMNS, row, strict=True)) for k, row in enumerate(stretch.rows.tolist())}
        first += len(stretch)
    expected = expected_sweeps(spec, trigger_settings, fed_records, force_at)
    assert [sweep_figures(sweep) for sweep in sweeps] == expected


COUNT, APART = 10_000, 50
"""Number of triggers in a synthetic recording, and the smallest distance between two of them in ticks."""


def make_records(kind: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, Callable[[], Condition]]:
    """Return records with COUNT triggers, the ticks of the triggers, and a function that makes their condition."""
    at = np.cumsum(rng.integers(APART, 2 * APART, COUNT))
    ticks = int(at[-1]) + APART
    rows = np.zeros((ticks, len(COLUMNS)))
    noise = rng.uniform(-0.4, 0.4, ticks)
    high = np.zeros(ticks, bool)
    for k in range(20):
        high[at + k] = True
    if kind == "edge":
        rows[:, 3] = high + np.where(np.isin(np.arange(ticks), at), np.abs(noise), noise)
        return rows, at, lambda: Edge("s", 1.0, hysteresis=0.5)
    if kind == "window":
        rows[:, 3] = np.where(high, rng.choice([-1.0, 1.0], ticks), noise)
        return rows, at, lambda: Window("s", -0.4, 0.4)
    if kind == "trip":
        rows[:, 0] = (
            rng.integers(0, 128, ticks) + 256.0 * high * 2.0 ** rng.integers(0, 12, COUNT)[(np.cumsum(high) - 1) // 20]
        )
        return rows, at, Tripped
    if kind == "mode":
        rows[:, 1] = np.cumsum(np.isin(np.arange(ticks), at)) % 4
        return rows, at, ModeChanged
    if kind == "late":
        rows[at, 2] = rng.integers(1, 9, COUNT)
        return rows, at, Late
    rows[at, 3] = rng.choice([-0.01, 0.01], COUNT)  # For one tick: the signal steps back while the sweep is open.
    return rows, at, lambda: Stepped("s", 0.005)


@pytest.mark.parametrize("kind", ["edge", "window", "trip", "mode", "late", "step"])
def test_ten_thousand_triggers_each_at_its_tick(kind: str):
    rng = np.random.default_rng(19)
    rows, at, make_condition = make_records(kind, rng)
    trigger = Trigger(Settings(2, Mode.NORMAL, 0.0), make_condition)
    ends = np.unique(rng.integers(0, len(rows), 1000)).tolist()
    triggers = [sweep.trigger for stretch in split_rows(0, rows, ends) for sweep in trigger.feed(stretch)]
    assert triggers == at.tolist()


@pytest.mark.parametrize(
    ("make_condition", "before", "after", "expected"),
    [
        (lambda: Edge("s", 1.0, hysteresis=0.5), [0.0], [1.0, 0.0], [(20, 10)]),  # reached in the gap
        (lambda: Edge("s", 1.0, hysteresis=0.5), [0.0], [0.7, 1.0], []),  # perhaps reached in the gap, not left since
        (lambda: Edge("s", 1.0, hysteresis=0.5), [0.0], [0.4, 1.0], [(21, 0)]),
        (lambda: Edge("s", 1.0, Slope.FALLING, 0.5), [2.0], [1.3, 1.0, 1.6, 1.0], [(23, 0)]),
        (lambda: Window("s", -1.0, 1.0), [0.0], [2.0, 2.0], [(20, 10)]),
        (lambda: Window("s", -1.0, 1.0), [0.0], [np.nan, 2.0], []),
        (lambda: Stepped("s", 1.0), [0.0], [5.0, 5.0, 2.0], [(22, 0)]),  # may have been a ramp in the gap
    ],
)
def test_a_trigger_within_lost_ticks_is_found_if_the_next_tick_shows_it(
    make_condition: Callable[[], Condition], before: list[float], after: list[float], expected: list[tuple[int, int]]
):
    """Ten ticks are lost; a trigger at the next tick may have happened in any of them, and has them as uncertain."""
    trigger = Trigger(Settings(1, Mode.NORMAL), make_condition)
    make_rows = lambda values: np.array([(0.0, 0.0, 0.0, value) for value in values])
    assert trigger.feed(Stretch(COLUMNS, 10 - len(before), make_rows(before))) == []
    sweeps = trigger.feed(Stretch(COLUMNS, 20, make_rows(after), 10))
    assert [(sweep.trigger, sweep.uncertain_ticks) for sweep in sweeps] == expected


def test_noise_within_the_hysteresis_is_no_trigger():
    rows = np.zeros((1000, 4))
    rows[:, 3] = 1.0 + np.random.default_rng(2).uniform(-0.45, 0.45, 1000)
    rows[500, 3] = 0.49
    trigger = Trigger(Settings(1, Mode.NORMAL), lambda: Edge("s", 1.0, hysteresis=0.5))
    reached = int(501 + np.flatnonzero(rows[501:, 3] >= 1.0)[0])
    assert [sweep.trigger for sweep in trigger.feed(Stretch(COLUMNS, 0, rows))] == [reached]


def test_every_new_cause_is_a_trip():
    """A new trip counts beside a latched one and across stretches; a trip that the first tick has does not count."""
    rows = np.zeros((8, 4))
    rows[:, 0] = [256, 256, 256 + 1024, 256 + 1024 + 7, 0, 256, 512, 512]
    for ends in ([], [2], [6], [1, 2, 3, 4, 5, 6, 7]):
        trigger = Trigger(Settings(1, Mode.NORMAL), Tripped)
        assert [sweep.trigger for stretch in split_rows(0, rows, ends) for sweep in trigger.feed(stretch)] == [2, 5, 6]


def test_a_step_for_one_tick_is_one_sweep_each_way():
    """The step is added to a ramp, whose slope is no step."""
    rows = np.zeros((100, 4))
    rows[:, 3] = 0.001 * np.arange(100)
    rows[60, 3] += 5.0
    trigger = Trigger(Settings(1, Mode.NORMAL), lambda: Stepped("s", 1.0))
    triggers = [sweep.trigger for stretch in split_rows(0, rows, [30, 60, 61]) for sweep in trigger.feed(stretch)]
    assert triggers == [60, 61]


def test_another_run_discards_the_open_sweep():
    """An open sweep can be closed early with the ticks so far; a rise from one run to the next is no edge, and the
    hold-off ends with the run.
    """
    low, high = np.zeros((50, 4)), np.ones((50, 4))
    low[40, 3] = 2.0
    trigger = Trigger(Settings(20, Mode.NORMAL, 0.0, 1000), lambda: Edge("s", 1.0))
    assert trigger.feed(Stretch(COLUMNS, 0, low)) == []
    assert trigger.close() == Sweep(0, 40, 40, 50, Cause.TRIGGER)
    assert trigger.feed(Stretch(COLUMNS, 0, high, 0, 1)) == []
    assert trigger.open_sweep is None
    assert trigger.close() is None
    assert trigger.feed(Stretch(COLUMNS, 50, low, 0, 1)) == []
    assert trigger.close() == Sweep(1, 90, 90, 100, Cause.TRIGGER)


def test_a_single_sweep_waits_to_be_armed():
    rows = np.zeros((100, 4))
    rows[10::10, 3] = 1.0
    trigger = Trigger(Settings(2, Mode.SINGLE, 0.0), lambda: Edge("s", 1.0))
    assert [sweep.trigger for sweep in trigger.feed(Stretch(COLUMNS, 0, rows[:50]))] == [10]
    trigger.arm()
    assert [sweep.trigger for sweep in trigger.feed(Stretch(COLUMNS, 50, rows[50:]))] == [50]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Settings(0), "trigger ticks: 0; allowed: at least 1"),
        (lambda: Settings(5, pre_percent=101.0), "trigger pre_percent: 101; allowed: 0 … 100"),
        (lambda: Settings(5, pre_percent=float("nan")), "trigger pre_percent: nan; allowed: 0 … 100"),
        (lambda: Settings(5, holdoff_ticks=-1), "trigger holdoff_ticks: -1; allowed: at least 0"),
        (lambda: Edge("s", float("nan")), "trigger level: nan"),
        (lambda: Edge("s", 0.0, hysteresis=-5.0), "trigger hysteresis: -5; allowed: 0 or more"),
        (lambda: Window("s", 1.0, 1.0), "trigger window: from 1 to 1"),
        (lambda: Stepped("s", -1.0), "trigger threshold: -1; allowed: 0 or more"),
        (lambda: Trigger(Settings(5), lambda: Edge("x", 0.0)).feed(Stretch(COLUMNS, 0, np.zeros((1, 4)))),
         "signal 'x': not recorded; allowed: flags, mode"),
    ],
)  # fmt: skip
def test_bad_settings_are_refused(make: Callable[[], object], message: str):
    with pytest.raises(ValueError, match=message):
        make()
