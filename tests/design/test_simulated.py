"""Simulated steps and noise at rest, compared with recorded runs of the same rig, scipy and linear analysis."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import linalg

from rtloop.analysis.held_plant import POINTS
from rtloop.analysis.step_response import step_response
from rtloop.configuration.axis import LimitsOptions
from rtloop.configuration.file import Configuration, load, parse
from rtloop.configuration.prepare import prepare
from rtloop.design.synthesis.specification import DesignOptions, SensorOptions, SimulationOptions
from rtloop.design.verification.bench import Bench, HardwareModel
from rtloop.design.verification.judgement import loop_quantities
from rtloop.design.verification.simulated_steps import SimulatedStep
from rtloop.design.verification.simulation import simulate, step_quantiles
from rtloop.errors import ConfigError
from rtloop.foundation.options import Options
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.residual_hysteresis import add_residual_hysteresis
from rtloop.signals import axis_column, column_names
from tests.recording.real_loop import ROOT, RealLoop, changed_configuration
from tests.stage_text import one_axis, resonance, simulated_stage

PAPER = load(ROOT / "deploy" / "paper.toml")
OMEGA, ZETA, KI, RATE_HZ = 2 * np.pi * 400.0, 0.1, 200.0, 10_000.0
LINEAR = f"""
[loop]
rate_hz = {RATE_HZ}
{simulated_stage(OMEGA, ZETA, 4.0, 5.0, seed=3)}
[driver.plant.sensor]
um_per_v = 5.0
noise_um = 0.02
resolution_um = 0.0
[driver.plant.adc]
bits = 0
[driver.plant.dac]
bits = 0
{one_axis(um_per_v=4.0)}
[axis.controller]
form = "transfer_function"
numerator = [{KI}]
denominator = [1.0, 0.0]
method = "tustin"
[axis.model]
{resonance(OMEGA, ZETA)}
[axis.limits]
command_um = 30.0
"""


def linear_rig(lines: str = "") -> Configuration:
    """Return the configuration LINEAR, whose inverse is exact, with `lines` of TOML added."""
    return parse(LINEAR + lines, "linear", Path(), "linear")


def test_a_simulation_is_the_run_itself() -> None:
    """The paper's loop, steps of 20 µm, recorded and simulated: every column of every tick, to the last bit."""
    text = changed_configuration(
        ("levels = [20.0, 0.0, -20.0, 0.0]\ndwell_s = 0.2", "levels = [0.0, 20.0, -20.0]\ndwell_s = 0.05")
    )
    recorded = RealLoop(text)
    recorded.run(1500)
    rows = recorded.block.ring("ticks").slots[:1500]
    names = column_names(["x"], ["x_true_position_um", "x_hysteresis_um"])
    run = Bench(PAPER, {}).run("x", (0.0, 20.0, -20.0), 0.05)
    assert tuple(run) == names
    for name, column in zip(names, rows.T, strict=True):
        np.testing.assert_array_equal(run[name], column, err_msg=name)
    assert np.ptp(run["x_true_position_um"]) > 39
    assert rows[:, axis_column(0, 0)].any()


def test_positions_between_ticks_are_those_of_the_held_displacement() -> None:
    bench = Bench(linear_rig(), {})
    run = bench.run("x", (0.0, 10.0), 0.02)
    true_um = bench.true_positions(run, "x").ravel()
    a = np.array([[0.0, 1.0], [-(OMEGA**2), -2 * ZETA * OMEGA]])
    exponential = linalg.expm(np.block([[a, np.array([[0.0], [OMEGA**2]])], [np.zeros((1, 3))]]) / RATE_HZ / POINTS)
    state, positions = np.zeros(2), []
    for displacement in run["x_hysteresis_um"][1:]:
        for _ in range(POINTS):
            positions.append(state[0])
            state = exponential[:2, :2] @ state + exponential[:2, 2] * displacement
    np.testing.assert_allclose(true_um[: len(positions)], positions, atol=1e-9)
    np.testing.assert_allclose(true_um[::POINTS], run["x_true_position_um"], atol=1e-12)
    assert true_um.max() > run["x_true_position_um"].max()


def test_a_disturbance_moves_it_between_ticks_too() -> None:
    quiet = LINEAR.replace("noise_um = 0.02", "noise_um = 0.0")
    text = quiet.replace("[driver.plant.sensor]", "[driver.plant.disturbance]\nstep_um = 2.0\n[driver.plant.sensor]")
    bench = Bench(parse(text, "linear", Path(), "linear"), {})
    run = bench.run("x", (0.0,), 0.02)
    true_um = bench.true_positions(run, "x").ravel()
    np.testing.assert_allclose(true_um[::POINTS], run["x_true_position_um"], atol=1e-12)
    time_s = np.arange(POINTS) / POINTS / RATE_HZ  # the controller does not act in the first period
    damped = OMEGA * np.sqrt(1 - ZETA**2)
    decay = np.exp(-ZETA * OMEGA * time_s)
    swing = np.cos(damped * time_s) + ZETA * OMEGA / damped * np.sin(damped * time_s)
    np.testing.assert_allclose(true_um[:POINTS], 2.0 * (1 - decay * swing), atol=1e-12)


def test_a_linear_rig_is_simulated_as_it_is_predicted() -> None:
    """Noise at rest and a large step have the figures of the linear loop: the rig has no dead band and no rounding."""
    configuration = linear_rig()
    check = prepare(configuration).checks[0]
    assert check.plant is not None
    assert check.running is not None
    simulation = simulate(Bench(configuration, {}), configuration.axes[0], 1 / KI, DesignOptions())
    noise = loop_quantities(check.loop(check.plant, 0), SensorOptions(noise_um=0.02))
    assert simulation.noise_x_nm == pytest.approx(noise["noise_x_nm"], rel=0.1)
    assert simulation.noise_v_nm == pytest.approx(noise["noise_v_nm"], rel=0.1)
    largest = simulation.steps[-1]
    assert largest.height_um == 20.0
    assert largest.settling_ms == pytest.approx(1e3 * check.running.settling_time_s, abs=0.1)
    assert largest.overshoot_percent == pytest.approx(check.running.overshoot_percent, abs=0.1)
    assert largest.static_error_percent == pytest.approx(0.0, abs=0.02)
    assert largest.peak_drive_v == pytest.approx(20.0 * check.running.peak_command / 4.0, rel=0.01)
    assert (largest.limited, largest.trips) == ((), ())
    assert simulation.omitted_heights_um == (40.0,)
    assert simulation.truth == "the configured rig"


@pytest.mark.parametrize("latency_ticks", [0, 2])
def test_both_rows_of_taps_sections_and_latency_are_predicted_as_they_run(latency_ticks: int) -> None:
    """A rig without noise follows the linear analysis of the same configuration, at and between ticks."""
    quiet = LINEAR.replace("noise_um = 0.02", "noise_um = 0.0").replace(
        "seed = 3", f"seed = 3\nlatency_ticks = {latency_ticks}"
    )
    prefilter = """
[axis.prefilter]
taps = [0.25, 0.0, 0.5, 0.15]
command_taps = [0.6, -0.3, 0.2]
sections = [[0.2, 0.1, 0.05, -0.9, 0.25]]
"""
    configuration = parse(quiet + prefilter, "linear", Path(), "linear")
    check = prepare(configuration).checks[0]
    assert check.plant is not None
    assert check.delay_ticks == latency_ticks
    bench = Bench(configuration, {})
    run = bench.run("x", (0.0, 10.0), 0.1)
    response = step_response(check.loop(check.plant, check.delay_ticks), 0.0999)
    np.testing.assert_allclose(10.0 * response.position, bench.true_positions(run, "x").ravel()[8000:], atol=1e-8)
    np.testing.assert_allclose(10.0 * response.command[::POINTS], run["x_command_um"][1000:], atol=1e-8)


@pytest.fixture(scope="module")
def paper():
    """Return the simulation of the paper's loop."""
    return simulate(Bench(PAPER, {}), PAPER.axes[0], 0.031, DesignOptions())


def test_what_is_not_linear_is_seen(paper) -> None:
    """Hysteresis that the inverse leaves makes small steps slow, a dead band makes the loop hunt, a limit is named."""
    assert [step.height_um for step in paper.steps] == [1.0, 5.0, 20.0, 40.0]
    small, *_, large = paper.steps
    assert small.overshoot_percent > 5 * 1.5
    assert small.settling_ms > 3 * 4.1
    assert large.limited == ("command",)
    assert small.limited == ()
    assert large.peak_drive_v <= 10.0


def test_noise_at_rest_is_that_of_a_run(paper) -> None:
    """The oracle is the recorded loop at rest at 5 µm, at another time and with another seed."""
    text = changed_configuration(("seed = 1 ", "seed = 8 "), ("levels = [20.0, 0.0, -20.0, 0.0]", "levels = [5.0]"))
    recorded = RealLoop(text)
    recorded.run(15_000)
    rows = recorded.block.ring("ticks").slots[5_000:15_000]
    assert len(rows) == 10_000
    names = column_names(["x"], ["x_true_position_um", "x_hysteresis_um"])
    rms = {name: 1e3 * rows[:, names.index(name)].std() for name in ("x_command_um", "x_true_position_um")}
    assert paper.noise_v_nm == pytest.approx(rms["x_command_um"], rel=0.35)
    assert paper.noise_x_nm == pytest.approx(rms["x_true_position_um"], rel=0.6)
    assert paper.noise_v_nm > 5 * 12.95  # the linear loop has 12.95 nm


def test_an_amplifier_with_one_side_steps_to_that_side() -> None:
    configuration = linear_rig()
    axis = configuration.axes[0].model_copy(update={"limits": LimitsOptions(drive_min_v=0.0, command_um=30.0)})
    configuration = replace(configuration, axes=(axis,))
    design = DesignOptions.model_validate({"simulation": {"steps_um": [20.0]}})
    (step,) = simulate(Bench(configuration, {}), axis, 1 / KI, design).steps
    assert step.settling_ms < 20


def test_a_model_stands_for_hardware() -> None:
    """The rig is built without residual hysteresis, and with the value of a compensation experiment."""
    hardware_setup = replace(PAPER, driver_kind="card", driver_options=Options())
    exact_model = HardwareModel(PAPER.axes[0].model, 0.01, 0.01, None, 0.0)
    design = DesignOptions.model_validate({"simulation": {"steps_um": [20.0]}})
    simulations = [
        simulate(Bench(hardware_setup, {"x": hardware}), hardware_setup.axes[0], 0.031, design)
        for hardware in (exact_model, exact_model._replace(residual_percent=3.75))
    ]
    assert {simulation.truth for simulation in simulations} == {"a rig built from the axis's models"}
    assert simulations[1].steps[0].overshoot_percent > simulations[0].steps[0].overshoot_percent
    with pytest.raises(ValueError, match=r"axis.x.model: missing; the simulation of the hardware"):
        Bench(hardware_setup, {"x": exact_model._replace(model=None)})
    with pytest.raises(ValueError, match=r"residual_percent: 90 %; allowed: 0, or above .* % and below .* %"):
        Bench(hardware_setup, {"x": exact_model._replace(residual_percent=90.0)})


@pytest.mark.parametrize(
    ("specification", "simulation", "heights_um", "counts"),
    [
        ({}, {}, (1.0, 5.0, 20.0, 40.0), ()),
        ({"command": {"reference_um": 18.0, "command_um": 20.0}}, {}, (1.0, 5.0, 20.0, 40.0, 18.0), (18.0,)),
        ({"command": {"reference_um": 40.1, "command_um": 50.0}}, {}, (1.0, 5.0, 20.0, 40.0), (40.0,)),
        ({"command": {"reference_um": 18.0, "command_um": 20.0}}, {"steps_um": [3.0]}, (3.0,), (3.0,)),
        ({}, {"residual_percent": 0.0}, (1.0, 5.0, 20.0, 40.0), (1.0, 5.0, 20.0, 40.0)),
        ({}, {"residual_percent": 3.0, "judged": False}, (1.0, 5.0, 20.0, 40.0), ()),
        ({}, {"judged": True}, (1.0, 5.0, 20.0, 40.0), (1.0, 5.0, 20.0, 40.0)),
    ],
)
def test_the_step_that_is_asked_for_is_simulated_and_judged(specification, simulation, heights_um, counts) -> None:
    """The specification's own height counts; named heights, or a stated residual hysteresis, make all of them count."""
    design = DesignOptions.model_validate({"specification": specification, "simulation": simulation})
    assert (design.step_heights_um, design.counted_heights_um) == (heights_um, counts)


def test_what_cannot_run_is_not_simulated() -> None:
    without_controller = replace(PAPER, axes=(PAPER.axes[0].model_copy(update={"controller": None}),))
    with pytest.raises(ConfigError, match="mode closed_loop needs it"):
        Bench(without_controller, {})


@pytest.mark.parametrize("percent", [2.0, 3.75, 10.0])
def test_hysteresis_that_is_left_is_as_much_as_was_said(percent: float) -> None:
    """The oracle is h/H of the changed actuator behind the model's inverse, by plays that the test computes."""
    model = PlayModel(np.array([0.0, 1.0, 2.0, 4.0, 6.0]), np.array([1.3, 0.3, 0.2, 0.3, 0.2]))
    changed_model = add_residual_hysteresis(model, percent, 10.0)
    inverse = model.inverse()
    half_range_um = float(np.maximum(10.0 - model.thresholds, 0) @ model.weights)
    v = half_range_um * np.interp(np.arange(6001), [0, 1000, 3000, 5000, 6000], [0, 1, -1, 1, 0])
    y = simulate_plays(simulate_plays(v, inverse), changed_model)
    down, up = y[1000:3001], y[3000:5001][::-1]
    assert 100 * np.abs(down - up).max() / np.ptp(y[1000:]) == pytest.approx(percent, rel=0.03)
    assert np.ptp(y) == pytest.approx(2 * half_range_um, rel=1e-3)


def simulate_plays(values: np.ndarray, model: PlayModel) -> np.ndarray:
    """Return the weighted sum of a model's plays for each value, computed sample by sample from rest."""
    outputs, positions = np.zeros(model.thresholds.size), []
    for value in values:
        outputs = np.maximum(value - model.thresholds, np.minimum(value + model.thresholds, outputs))
        positions.append(model.weights @ outputs)
    return np.array(positions)


def test_as_many_steps_keep_what_is_said_of_them() -> None:
    """The oracle counts steps under other noise draws; noise decides the overshoot of the paper's loop."""
    height_um, cycles = 5.0, 12
    design = DesignOptions().model_copy(update={"simulation": SimulationOptions(steps_um=(height_um,), judged=False)})
    bench = Bench(PAPER, {})
    (simulated,) = simulate(bench, PAPER.axes[0], 0.03, design).steps
    assert simulated.typical[0] < 0.9 * simulated.overshoot_percent
    overshoots = []
    for draw in range(100, 108):
        levels = (0.0, *cycles * (height_um, 0.0, -height_um, 0.0))
        position = bench.run("x", levels, 0.36, draw)["x_true_position_um"].reshape(len(levels), -1)[1:]
        upwards = position * np.tile([1, -1, -1, 1], cycles)[:, None] / height_um
        overshoots.append(100 * (upwards.max(axis=1) - upwards[:, -720:].mean(axis=1)))
    assert 0.92 < np.mean(np.array(overshoots) <= simulated.overshoot_percent) < 0.98
    assert 0.4 < np.mean(np.array(overshoots) <= simulated.typical[0]) < 0.6


@pytest.mark.parametrize(
    ("quantile", "median", "in_time", "in_percent"),
    [
        (3.2, 3.0, True, True),
        (4.0, 3.0, False, False),
        (np.inf, 3.0, False, False),  # noise decides which steps settle
        (np.inf, np.inf, True, True),  # no step settles
    ],
)
def test_noise_decides_a_figure_whose_quantile_is_far_from_its_median(quantile, median, in_time, in_percent) -> None:
    step = SimulatedStep(5.0, *[quantile] * 3, (median,) * 3, 1.0, (), ())
    assert step.is_repeatable("settling_ms") == in_time
    assert step.is_repeatable("overshoot_percent") == step.is_repeatable("static_error_percent") == in_percent


def test_steps_that_did_not_reach_their_reference_count_as_the_worst() -> None:
    """95 of 100 steps keep the figures; where fewer steps reach their reference, the figures are the worst."""
    settled, unreached = [1.0, 2.0, 0.1], [np.nan, np.inf, 100.0]
    assert step_quantiles(np.array([settled] * 97 + [unreached] * 3)) == tuple(settled)
    assert step_quantiles(np.array([settled] * 90 + [unreached] * 10)) == (np.inf, np.inf, 100.0)
