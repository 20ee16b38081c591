"""Steps on a drive of -2 … 10 V: the range of positions, the simulated levels and the bounds of taps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtloop.configuration.axis import LimitsOptions, ModelOptions
from rtloop.configuration.file import Configuration, parse
from rtloop.design.robust.subject import command_range_um, step_bounds
from rtloop.design.synthesis.specification import DesignOptions, SimulationOptions
from rtloop.design.verification.bench import Bench
from rtloop.design.verification.simulation import simulate
from rtloop.design.verification.text import simulation_notes
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.reach import can_hold, reachable_range
from tests.unequal_stage import HIGHEST_V, LOWEST_V, STAGE, THRESHOLDS_V, WEIGHTS_UM_PER_V, Plays, curve, major_loop

MODEL = PlayModel(np.array(THRESHOLDS_V), np.array(WEIGHTS_UM_PER_V))


def stage(**limits: float) -> Configuration:
    """Return the configuration of the stage with the given [axis.limits] replaced."""
    configuration = parse(STAGE, "stage", Path(), "stage")
    (axis,) = configuration.axes
    changed = LimitsOptions.model_validate(axis.limits.model_dump() | limits)
    return replace(configuration, axes=(axis.model_copy(update={"limits": changed}),))


def test_the_range_of_positions_is_that_of_the_loop_between_both_ends() -> None:
    """The oracle is plays, sample by sample: from rest to 10 V, and back to -2 V, where memory adds 1.4 µm."""
    high_um, low_um = curve([HIGHEST_V, LOWEST_V])
    position_range = reachable_range(MODEL, LOWEST_V, HIGHEST_V)
    assert position_range == pytest.approx((low_um, high_um))
    assert low_um - curve([LOWEST_V])[0] > 1.0
    assert position_range.span_um == pytest.approx(major_loop()[1])
    assert reachable_range(MODEL, -HIGHEST_V, -LOWEST_V) == pytest.approx((-high_um, -low_um))
    negative = PlayModel(MODEL.thresholds, -MODEL.weights)
    assert reachable_range(negative, LOWEST_V, HIGHEST_V) == pytest.approx((-high_um, -low_um))


def test_a_limit_of_the_command_moves_the_other_end_too() -> None:
    plays = Plays()
    plays.drive_to(20.0)
    assert reachable_range(MODEL, LOWEST_V, HIGHEST_V, 20.0) == pytest.approx((plays.move(LOWEST_V), 20.0))


@given(st.lists(st.floats(-9.0, 41.0), min_size=1, max_size=6))
@settings(max_examples=60, deadline=None)
def test_positions_are_held_where_the_drive_that_they_need_is_allowed(positions_um: list[float]) -> None:
    plays = Plays()
    drives_v = [plays.drive_to(position) for position in positions_um]
    if min(abs(drive - end) for drive in drives_v for end in (LOWEST_V, HIGHEST_V)) > 1e-6:
        is_allowed = min(drives_v) > LOWEST_V and max(drives_v) < HIGHEST_V
        assert can_hold(MODEL, positions_um, LOWEST_V, HIGHEST_V) is is_allowed


def test_a_dead_band_takes_its_part_on_both_sides() -> None:
    model = PlayModel(MODEL.thresholds + 0.5, MODEL.weights)
    position_um = curve([HIGHEST_V - 0.5])[0]
    assert can_hold(model, [position_um - 1e-6], LOWEST_V, HIGHEST_V)
    assert not can_hold(model, [position_um + 1e-3], LOWEST_V, HIGHEST_V)


@pytest.mark.usefixtures("few_simulated_steps")
def test_large_steps_are_simulated_within_the_range_of_the_longer_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """1 µm about 0, 20 µm between 0 and 20, 43 µm in the middle of the 44.8 µm; 46 µm have no room."""
    configuration = stage()
    bench, (axis,) = Bench(configuration, {}), configuration.axes
    heights_um = set[float]()
    plain_run = bench.run

    def spied_run(axis: str, levels_um: Sequence[float], dwell_s: float, noise_draw: int = 0) -> dict:
        heights_um.update(np.round(np.abs(np.diff(levels_um)), 9).tolist())
        return plain_run(axis, levels_um, dwell_s, noise_draw)

    monkeypatch.setattr(bench, "run", spied_run)
    design = DesignOptions(simulation=SimulationOptions(steps_um=(1.0, 20.0, 43.0, 46.0)))
    simulation = simulate(bench, axis, 1 / 600.0, design)
    high_um, low_um = curve([HIGHEST_V, LOWEST_V])
    middle_um = (low_um + high_um) / 2
    expected = [(-1.0, 1.0), (0.0, 20.0), (middle_um - 21.5, middle_um + 21.5)]
    assert [step.height_um for step in simulation.steps] == [1.0, 20.0, 43.0]
    assert [step.levels_um for step in simulation.steps] == [pytest.approx(levels) for levels in expected]
    assert heights_um == {1.0, 20.0, 43.0}  # the first step of a run, too
    for step in simulation.steps:
        assert (step.limited, step.trips) == ((), ())
        assert step.static_error_percent < 2.0
    assert simulation.omitted_heights_um == (46.0,)
    assert simulation.as_dict()["range_um"] == pytest.approx([low_um, high_um])


@pytest.mark.usefixtures("few_simulated_steps")
def test_a_drive_that_is_mostly_negative_is_the_mirror_image() -> None:
    configuration = stage(drive_v=2.0, drive_min_v=-10.0)
    design = DesignOptions(simulation=SimulationOptions(steps_um=(20.0,)))
    (step,) = simulate(Bench(configuration, {}), configuration.axes[0], 1 / 600.0, design).steps
    assert step.levels_um == (-20.0, 0.0)
    assert (step.limited, step.trips) == ((), ())


def test_omitted_steps_are_told_with_both_ends_of_the_range() -> None:
    high_um, low_um = curve([HIGHEST_V, LOWEST_V])
    result = SimpleNamespace(
        truth="the rig", noise_x_nm=1.0, noise_v_nm=1.0, omitted_heights_um=(46.0,), required={}, is_judged=False,
        steps=(),
        command_range=reachable_range(MODEL, LOWEST_V, HIGHEST_V),
    )  # fmt: skip
    (_, note) = simulation_notes(SimpleNamespace(simulated=result, rows=[]))  # type: ignore[arg-type]
    assert note == f"Steps of 46 µm were left out: the command's range is {low_um:.4g} … {high_um:.4g} µm."


def require_steps(reference_um: float, command_um: float) -> DesignOptions:
    """Return a design for steps of `reference_um` (µm) with commands up to `command_um` (µm)."""
    command = {"reference_um": reference_um, "command_um": command_um}
    return DesignOptions.model_validate({"specification": {"overshoot_percent": 1.0, "command": command}})


MODEL_OPTIONS = ModelOptions(gain=4.0, denominator=((1.0, 2.0, 4.0),))


def test_taps_step_between_0_and_the_reference_where_the_sides_are_unequal() -> None:
    (axis,) = stage().axes
    high_um, low_um = curve([HIGHEST_V, LOWEST_V])
    assert command_range_um(axis) == pytest.approx((low_um, high_um))
    bounds = step_bounds(axis, MODEL_OPTIONS, require_steps(34.5, 38.0))
    assert (bounds.lowest_um, bounds.step_um) == (0.0, 34.5)
    assert (bounds.low_um, bounds.high_um) == pytest.approx((low_um, high_um))
    lowest, highest = bounds.command_limits(np.array(1.0))
    assert lowest < 0.0 < 1.0 < highest  # the step and the step back have room beyond their ends
    assert step_bounds(axis, MODEL_OPTIONS, require_steps(3.0, 4.0)).lowest_um == -3.0  # 4 µm fit on both sides
    assert step_bounds(axis, MODEL_OPTIONS, require_steps(3.0, 38.0)).lowest_um == 0.0


def test_taps_of_a_drive_that_is_mostly_negative_are_those_of_its_mirror_image() -> None:
    (axis,), (mirrored,) = stage().axes, stage(drive_v=2.0, drive_min_v=-10.0).axes
    bounds, expected = (step_bounds(side, MODEL_OPTIONS, require_steps(34.5, 38.0)) for side in (mirrored, axis))
    assert bounds == pytest.approx(expected)


def test_equal_sides_keep_steps_to_both() -> None:
    (axis,) = stage(drive_min_v=-10.0).axes
    assert step_bounds(axis, MODEL_OPTIONS, require_steps(34.5, 38.0)).lowest_um == -34.5


def test_a_reference_beyond_the_drive_is_refused_with_key_value_and_what_is_possible() -> None:
    (axis,) = stage().axes
    key = r"specification\.command\.reference_um"
    message = rf"{key}: value is 50 µm; allowed: up to 40 µm, because the command .*limits\.drive_min_v = -2"
    with pytest.raises(ValueError, match=message):
        step_bounds(axis, MODEL_OPTIONS, require_steps(50.0, 55.0))
    half_gain = MODEL_OPTIONS.model_copy(update={"gain": 2.0})  # D(0) = 0.5: the command is twice the position
    with pytest.raises(ValueError, match=r"value is 30 µm; allowed: up to 20 µm"):
        step_bounds(axis, half_gain, require_steps(30.0, 55.0))
