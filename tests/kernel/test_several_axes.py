"""Axes of one law do not disturb each other, and a snapshot of several axes comes back whole."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.kernel.access import axis_state
from rtloop.kernel.layout import CONDITIONS, LOOP_STATE
from rtloop.kernel.memory import LawMemory, copy_records, field_tables, new_records
from rtloop.kernel.step import all_coefficients_fit, evaluate, set_mode, update
from rtloop.laws.binding import bind_functions
from rtloop.laws.registry import law_layout
from rtloop.signals import Mode
from tests.kernel.harness import LAWS, coefficients_of

LAYOUT = law_layout(LAWS)
LAG = {"form": "zpk", "gain": 30.0, "zeros": [], "poles": [[-40.0, 0.0]]}
INTEGRATOR = {"form": "zpk", "gain": 20.0, "zeros": [], "poles": [[0.0, 0.0]]}
TICKS = 60
RANDOM = np.random.default_rng(5)
REFERENCES, ADC_V = RANDOM.normal(0, 3, (TICKS, 2)), RANDOM.normal(0, 0.2, (TICKS, 2))
PARTS = [coefficients_of(controller=LAG), coefficients_of(controller=INTEGRATOR, limits={"command_um": 9.0})]


def law_of(*parts: np.ndarray) -> LawMemory:
    """A law in closed loop whose axes have these coefficients."""
    law = LawMemory.create_at_rest(LAYOUT, bind_functions(LAWS), copy_records(np.concatenate(parts)))
    set_mode(law.law, int(Mode.FEEDFORWARD), True)
    return law


def step(law: LawMemory, axes: slice) -> np.ndarray:
    """(drive, command) of each axis in each tick, shape (ticks, axes, 2); the loop closes in tick 10."""
    conditions, feeds = new_records(CONDITIONS, 1)[0], np.zeros(2)[axes]
    rows = []
    for k in range(TICKS):
        if k == 10:
            set_mode(law.law, int(Mode.CLOSED_LOOP), False)
        evaluate(law.law, ADC_V[k, axes].copy(), REFERENCES[k, axes].copy(), feeds, conditions)
        update(law.law)
        states = [axis_state(law.law, a) for a in range(feeds.size)]
        rows.append([(state.drive_v, state.command_um) for state in states])
    return np.array(rows)


def test_each_of_two_axes_computes_what_it_computes_alone():
    together = step(law_of(*PARTS), slice(0, 2))
    for a, part in enumerate(PARTS):
        np.testing.assert_array_equal(together[:, a], step(law_of(part), slice(a, a + 1))[:, 0])
    assert np.ptp(together[10:, 0]) > 0.1
    assert np.ptp(together[10:, 1]) > 0.1


def snapshot(law: LawMemory, tick: int) -> bytes:
    """The bytes that a recording stores: tick, coefficients, axes, loop."""
    return tick.to_bytes(8, "little") + law.coefficients.tobytes() + law.axes.tobytes() + law.state.tobytes()


def test_a_snapshot_of_two_axes_comes_back_whole():
    law = law_of(*PARTS)
    step(law, slice(0, 2))
    tick, coefficients, axes, loop = LAYOUT.split_snapshot(snapshot(law, 77), 2)
    assert tick == 77
    assert (coefficients.tobytes(), axes.tobytes(), loop.tobytes()) == (
        law.coefficients.tobytes(), law.axes.tobytes(), law.state.tobytes()
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"\d+ bytes; allowed for 2 axes: \d+"):
        LAYOUT.split_snapshot(snapshot(law, 77)[:-1], 2)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(
    ("kind", "field", "wrong"),
    [
        ("coefficients", "controller_law", len(LAWS)),
        ("coefficients", "feedforward_law", len(LAWS)),
        ("coefficients", "controller_axes", 3),
        ("coefficients", "tap_count", 129),
        ("axes", "tap_index", 129),
        ("axes", "swing_direction", 2),
        ("axes", "swing_direction", -2),
    ],
)
def test_a_snapshot_with_a_number_out_of_bounds_is_refused(axis: int, kind: str, field: str, wrong: int):
    law = law_of(*PARTS)
    getattr(law, kind)[field][axis] = wrong
    with pytest.raises(ValueError, match=field):
        LAYOUT.split_snapshot(snapshot(law, 0), 2)


def test_the_last_law_of_a_layout_is_allowed():
    """A law's number goes from 0 to one less than their count; both ends belong to a law of the right slot."""
    ends = {LAYOUT.laws[0].slot: 0, LAYOUT.laws[-1].slot: len(LAYOUT.laws) - 1}
    for slot, number in ends.items():
        law = law_of(PARTS[0])
        assert int(law.coefficients[f"{slot}_law"][0]) == number
        LAYOUT.split_snapshot(snapshot(law, 0), 1)
    assert len(ends) == len(LAYOUT.laws) == 2


def test_fields_of_an_axis_cover_its_record_without_gaps():
    law = law_of(*PARTS)
    tables = field_tables(LAYOUT, law.coefficients, "coefficients")
    assert len(tables) == 2
    for table in tables:
        places = sorted((offset, np.dtype(kind).itemsize) for _, kind, offset in table if np.dtype(kind).itemsize)
        ends = [offset + size for offset, size in places]
        assert [offset for offset, _ in places] == [0, *ends[:-1]]
        assert ends[-1] == LAYOUT.coefficients.itemsize


def test_loop_state_of_a_snapshot_is_checked():
    law = law_of(PARTS[0])
    law.state["mode"] = 100
    with pytest.raises(ValueError, match="mode"):
        LAYOUT.split_snapshot(snapshot(law, 0), 1)
    assert law.state.dtype == LOOP_STATE


@pytest.mark.parametrize(
    ("counts", "fits"),
    [
        ((1, 1), True),
        ((0, 1), False),
        ((1, 0), False),
        ((0, 0), False),
        ((2, 1), False),
        ((2, 0), False),
        ((3, 0), False),
    ],
)
def test_each_axis_has_one_controller(counts: tuple[int, int], fits: bool):
    """A controller of two axes needs one that is made for two: the shipped one of a single axis does not fit."""
    law = law_of(*PARTS)
    law.coefficients["controller_axes"] = counts
    assert all_coefficients_fit(law.law) == fits
