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
from tests.kernel.harness import LAWS, make_coefficients

LAYOUT = law_layout(LAWS)
LAG = {"form": "zpk", "gain": 30.0, "zeros": [], "poles": [[-40.0, 0.0]]}
INTEGRATOR = {"form": "zpk", "gain": 20.0, "zeros": [], "poles": [[0.0, 0.0]]}
TICKS = 60
RANDOM = np.random.default_rng(5)
REFERENCES, ADC_V = RANDOM.normal(0, 3, (TICKS, 2)), RANDOM.normal(0, 0.2, (TICKS, 2))
PARTS = [make_coefficients(controller=LAG), make_coefficients(controller=INTEGRATOR, limits={"command_um": 9.0})]


def make_law(*parts: np.ndarray) -> LawMemory:
    """Return a law in mode feedforward whose axes have the coefficients `parts`."""
    law = LawMemory.create_at_rest(LAYOUT, bind_functions(LAWS), copy_records(np.concatenate(parts)))
    set_mode(law.law, int(Mode.FEEDFORWARD), True)
    return law


def run_law(law: LawMemory, axes: slice) -> np.ndarray:
    """Run TICKS ticks, in closed loop from tick 10; return (drive, command) of each axis, shape (ticks, axes, 2)."""
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
    joint = run_law(make_law(*PARTS), slice(0, 2))
    for a, part in enumerate(PARTS):
        np.testing.assert_array_equal(joint[:, a], run_law(make_law(part), slice(a, a + 1))[:, 0])
    assert np.ptp(joint[10:, 0]) > 0.1
    assert np.ptp(joint[10:, 1]) > 0.1


def snapshot(law: LawMemory, tick: int) -> bytes:
    """Return the bytes that a recording stores: tick, coefficients, axes, loop."""
    return tick.to_bytes(8, "little") + law.coefficients.tobytes() + law.axes.tobytes() + law.state.tobytes()


def test_a_snapshot_of_two_axes_comes_back_whole():
    law = make_law(*PARTS)
    run_law(law, slice(0, 2))
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
    law = make_law(*PARTS)
    getattr(law, kind)[field][axis] = wrong
    with pytest.raises(ValueError, match=field):
        LAYOUT.split_snapshot(snapshot(law, 0), 2)


def test_the_last_law_of_a_layout_is_allowed():
    """Numbers of laws go from 0 to one less than their count; the laws at both ends are in the slots of this axis."""
    end_numbers = {LAYOUT.laws[0].slot: 0, LAYOUT.laws[-1].slot: len(LAYOUT.laws) - 1}
    for slot, number in end_numbers.items():
        law = make_law(PARTS[0])
        assert int(law.coefficients[f"{slot}_law"][0]) == number
        LAYOUT.split_snapshot(snapshot(law, 0), 1)
    assert len(end_numbers) == len(LAYOUT.laws) == 2


def test_fields_of_an_axis_cover_its_record_without_gaps():
    law = make_law(*PARTS)
    tables = field_tables(LAYOUT, law.coefficients, "coefficients")
    assert len(tables) == 2
    for table in tables:
        fields = sorted((offset, np.dtype(kind).itemsize) for _, kind, offset in table if np.dtype(kind).itemsize)
        ends = [offset + size for offset, size in fields]
        assert [offset for offset, _ in fields] == [0, *ends[:-1]]
        assert ends[-1] == LAYOUT.coefficients.itemsize


def test_loop_state_of_a_snapshot_is_checked():
    law = make_law(PARTS[0])
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
    """Coefficients fit only if each axis has one controller: the shipped controller of one axis cannot serve two."""
    law = make_law(*PARTS)
    law.coefficients["controller_axes"] = counts
    assert all_coefficients_fit(law.law) == fits
