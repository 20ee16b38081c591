"""A drive of 0 … 10 V: steps and taps stay above the remanence, and a note names the static error."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtloop.analysis.held_plant import POINTS
from rtloop.cli.verify import _write_report
from rtloop.configuration.axis import LimitsOptions, ModelOptions
from rtloop.configuration.checks import Findings, check_axes
from rtloop.configuration.file import Configuration, parse
from rtloop.design.robust.subject import command_range_um, step_bounds
from rtloop.design.synthesis.specification import DesignOptions, SimulationOptions
from rtloop.design.verification.axes import verify_axis
from rtloop.design.verification.bench import Bench
from rtloop.design.verification.json_values import as_dict
from rtloop.design.verification.judgement import Limit
from rtloop.design.verification.simulated_steps import SimulatedStep, SimulationResult
from rtloop.design.verification.simulation import CYCLES, _run_steps, _summarise_steps, simulate
from rtloop.design.verification.text import simulation_notes
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.reach import PositionRange, reachable_range
from rtloop.signals import Flag
from tests.unequal_stage import HIGHEST_V, STAGE, THRESHOLDS_V, WEIGHTS_UM_PER_V, Plays, curve

MODEL = PlayModel(np.array(THRESHOLDS_V), np.array(WEIGHTS_UM_PER_V))
HIGH_UM, REMANENCE_UM = curve([HIGHEST_V, 0.0])


def stage() -> Configuration:
    """Return the configuration of the stage with a drive from 0 V on."""
    configuration = parse(STAGE, "stage", Path(), "stage")
    (axis,) = configuration.axes
    limits = LimitsOptions.model_validate(axis.limits.model_dump() | {"drive_min_v": 0.0})
    return replace(configuration, axes=(axis.model_copy(update={"limits": limits}),))


def test_the_range_ends_at_the_remanence() -> None:
    """The plays, computed sample by sample, give 44 µm at 10 V, and 4 µm when the drive is back at 0 V."""
    assert REMANENCE_UM > 3.0
    assert reachable_range(MODEL, 0.0, HIGHEST_V) == pytest.approx((REMANENCE_UM, HIGH_UM))
    negative = PlayModel(MODEL.thresholds, -MODEL.weights)
    assert reachable_range(negative, 0.0, HIGHEST_V) == pytest.approx((-HIGH_UM, -REMANENCE_UM))
    plays = Plays()
    plays.drive_to(20.0)
    assert reachable_range(MODEL, 0.0, HIGHEST_V, 20.0) == pytest.approx((plays.move(0.0), 20.0))
    assert reachable_range(PlayModel(np.zeros(1), np.ones(1)), 0.0, HIGHEST_V) == (0.0, HIGHEST_V)


@given(st.lists(st.floats(REMANENCE_UM + 0.01, HIGH_UM - 0.01), min_size=1, max_size=6))
@settings(max_examples=40, deadline=None)
def test_every_position_of_the_range_is_reached_after_any_other(positions_um: list[float]) -> None:
    plays = Plays()
    drives_v = [plays.drive_to(position) for position in positions_um]
    assert min(drives_v) > 0.0
    assert max(drives_v) < HIGHEST_V


@pytest.mark.usefixtures("few_simulated_steps")
def test_steps_are_simulated_where_the_drive_reaches_both_levels() -> None:
    """No step ends at the remanence, which the plays leave 4 µm above 0; 41 µm are more than the range."""
    configuration = stage()
    design = DesignOptions(simulation=SimulationOptions(steps_um=(1.0, 35.0, 41.0)))
    simulation = simulate(Bench(configuration, {}), configuration.axes[0], 1 / 600.0, design)
    middle_um = (HIGH_UM + REMANENCE_UM) / 2
    levels = [(middle_um - height / 2, middle_um + height / 2) for height in (1.0, 35.0)]
    assert [step.levels_um for step in simulation.steps] == [pytest.approx(pair) for pair in levels]
    for step in simulation.steps:
        assert (step.limited, step.trips) == ((), ())
        assert step.settling_ms < 20.0
        assert step.static_error_percent < 1.0
    assert simulation.omitted_heights_um == (41.0,)


MODEL_OPTIONS = ModelOptions(gain=4.0, denominator=((1.0, 2.0, 4.0),))


def require_steps(reference_um: float) -> DesignOptions:
    """Return a design for steps of `reference_um` (µm) with commands up to 1.2 times as large."""
    command = {"reference_um": reference_um, "command_um": 1.2 * reference_um}
    return DesignOptions.model_validate({"specification": {"overshoot_percent": 1.0, "command": command}})


def test_taps_step_in_the_middle_of_the_range() -> None:
    (axis,) = stage().axes
    assert command_range_um(axis) == pytest.approx((REMANENCE_UM, HIGH_UM))
    bounds = step_bounds(axis, MODEL_OPTIONS, require_steps(30.0))
    assert bounds.lowest_um - REMANENCE_UM == pytest.approx(HIGH_UM - bounds.highest_um)
    assert bounds.highest_um - bounds.lowest_um == pytest.approx(30.0)
    lowest, highest = bounds.command_limits(np.array(1.0))
    assert lowest == pytest.approx(1 - highest)
    assert lowest == pytest.approx((REMANENCE_UM - bounds.lowest_um) / 30.0)
    half_gain = MODEL_OPTIONS.model_copy(update={"gain": 2.0})  # D(0) = 0.5: the command is twice the position
    assert step_bounds(axis, half_gain, require_steps(15.0)).lowest_um == pytest.approx(bounds.lowest_um / 2)
    with pytest.raises(
        ValueError, match=rf"value is 41 µm; allowed: up to {HIGH_UM - REMANENCE_UM:.4g} µm, because the"
    ):
        step_bounds(axis, MODEL_OPTIONS, require_steps(41.0))


def make_result(step: SimulatedStep) -> SimulationResult:
    """Return a simulation with one step and limits on its static error and settling time."""
    limits = {"static_error_percent": Limit(0.2, True), "settling_ms": Limit(6.0, True)}
    return SimulationResult("the rig", (step,), (), PositionRange(REMANENCE_UM, HIGH_UM), 1.0, 1.0, limits, ())


def test_a_report_of_a_step_that_never_settles_is_valid_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Infinite figures become null: strict readers refuse Infinity. The report's pictures do not matter here."""
    monkeypatch.setattr("rtloop.design.verification.plots.draw_pictures", lambda *_: {})
    configuration = stage()
    (check,) = check_axes(configuration, Findings())
    spec = tmp_path / "spec.toml"
    spec.write_text("[specification]\nsettling_ms = 6.0\n", encoding="utf-8")
    verification, design = verify_axis(configuration, check, spec)
    step = SimulatedStep(40.0, np.inf, np.inf, 17.0, (np.inf, np.inf, 17.0), 7.5, ("drive",), ())
    unsettled = replace(verification, simulated=make_result(step))
    _write_report(tmp_path, "stage", {"x": (unsettled, design)}, {"axes": [as_dict(unsettled)]})
    report = json.loads((tmp_path / "verify.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)
    (step_values,) = report["axes"][0]["simulated"]["steps"]
    assert (step_values["settling_ms"], step_values["static_error_percent"]) == (None, 17.0)
    assert step_values["met"] == {"settling_ms": False, "static_error_percent": False}


@pytest.mark.parametrize(
    ("percent", "height_um", "measured_percent", "is_named"),
    [(0.1, 1.0, 2.4, True), (0.1, 1.0, 50.0, False), (0.1, 1.0, 0.19, False), (1e-12, 1.0, 2.4, False)],
)
def test_a_static_error_of_the_position_is_named(percent, height_um, measured_percent, is_named) -> None:
    """0.1 % of 24 µm is 2.4 % of a step of 1 µm: an integrator helps, if no other cause is larger."""
    step = SimulatedStep(height_um, 0.0, 1.0, measured_percent, (0.0, 1.0, measured_percent), 5.0, (), (), (23.0, 24.0))
    rows = [SimpleNamespace(name="static_error_percent", running=percent)]
    notes = simulation_notes(SimpleNamespace(simulated=make_result(step), rows=rows))  # type: ignore[arg-type]
    assert any("At 24 µm, this is 0.024 µm, or 2.4 % of a step of 1 µm" in note for note in notes) == is_named


@pytest.mark.parametrize(("clipped", "limited"), [(slice(0, 100), ()), (slice(250, 251), ("drive",))])
def test_a_limit_on_the_way_to_the_first_level_is_none_of_a_step(clipped: slice, limited: tuple[str, ...]) -> None:
    """Noise clips the drive at 0 V. The steps begin after the first 100 ticks; a trip counts before them, too."""
    reference_um = np.repeat([20.0, 10.0] * (CYCLES + 1), 100)[: 100 * (2 * CYCLES + 1)]
    flags = np.zeros(reference_um.size)
    flags[clipped] = Flag.DRIVE_LIMITED
    flags[50] = int(flags[50]) | Flag.TRIP_POSITION
    record = {"x_reference_um": reference_um, "x_drive_v": reference_um / 4, "flags": flags}
    bench = SimpleNamespace(
        rate_hz=1000.0,
        run=lambda *_: record,
        true_positions=lambda *_: np.repeat(reference_um[:, None], POINTS, axis=1),
    )
    run = _run_steps(bench, "x", (10.0, 20.0), 0.1, 0)  # type: ignore[arg-type]
    step = _summarise_steps(10.0, (10.0, 20.0), [run])
    assert step.limited == limited
    assert len(step.trips) == 1
