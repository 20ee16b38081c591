"""The stage of `rtloop init`: stable by poles from numpy, its figures are checked, and its specification can be met."""

from __future__ import annotations

import itertools
import math
import tomllib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import cont2discrete

from rtloop.campaigns.campaign_file import load_campaign
from rtloop.campaigns.case import CaseRunner
from rtloop.configuration.cautions import cautions
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.starters import folder
from rtloop.starters.stage import stage_files
from rtloop.starters.stage_figures import StageFigures, stage_figures

RESONANCES_HZ, DAMPINGS, RANGES_UM = (10.0, 100.0, 800.0, 5000.0), (0.002, 0.05, 0.7), (0.1, 20.0, 500.0)
GRID = list(itertools.product(RESONANCES_HZ, DAMPINGS, RANGES_UM))
ONE_SIDED: list[dict[str, float]] = [
    {"drive_min_v": -2.0, "hysteresis_percent": 12.0, "sensor_share": 0.1},
    {"drive_min_v": 0.0, "hysteresis_percent": 30.0, "sensor_share": 0.06},
    {"drive_min_v": -6.0, "drive_v": 7.5, "hysteresis_percent": 0.0, "sensor_share": 1.0},
]
"""Stages that move farther to one side; `sensor_share` is the sensor's µm/V over the travel in µm."""


def largest_pole(stage: dict, gain_factor: float = 1.0) -> float:
    """Return the largest magnitude of the closed loop's poles, with held plant, `delay_ticks` and integrator."""
    axis, rate_hz = stage["axis"][0], stage["loop"]["rate_hz"]
    (_, damping_term, stiffness) = axis["model"]["denominator"][0]
    assert axis["model"]["gain"] == stiffness
    numerator, denominator, _ = cont2discrete(([stiffness], [1.0, damping_term, stiffness]), 1 / rate_hz, "zoh")
    gain = gain_factor * axis["controller"]["ki_per_s"] / rate_hz
    open_loop = np.polymul(denominator, [1.0, -1.0])
    open_loop = np.concatenate([open_loop, np.zeros(axis["model"]["delay_ticks"])])  # · z^delay
    return float(np.max(np.abs(np.roots(np.polyadd(open_loop, gain * numerator.ravel())))))


def settling_s(stage: dict, points: int = 2000) -> float:
    """Return the time in s after which a step of the closed loop stays within 5 %, judged at `points` of a dwell."""
    axis, period_s = stage["axis"][0], 1 / stage["loop"]["rate_hz"]
    (_, damping_term, stiffness) = axis["model"]["denominator"][0]
    matrices = np.array([[0.0, 1.0], [-stiffness, -damping_term]]), np.array([[0.0], [stiffness]])
    a, b, *_ = cont2discrete((*matrices, np.array([[1.0, 0.0]]), np.zeros((1, 1))), period_s, "zoh")
    assert axis["model"]["delay_ticks"] == 1
    gain = axis["controller"]["ki_per_s"] * period_s
    loop = np.zeros((5, 5))  # position, speed, delayed command, integral, reference of 1
    loop[:2, :2], loop[:2, 2:3], loop[2, 3], loop[4, 4] = a, b, 1.0, 1.0
    loop[3, [0, 3, 4]] = -gain, 1.0, gain
    ticks = max(1, round(axis["reference"]["dwell_s"] / period_s / points))
    several, state, last = np.linalg.matrix_power(loop, ticks), np.array([0.0, 0.0, 0.0, 0.0, 1.0]), 0
    for point in range(1, points + 1):
        state = several @ state
        if abs(state[0] - 1) > 0.05:
            last = point
    return last * ticks * period_s


def one_sided_figures(resonance_hz: float, damping: float, range_um: float, sides: dict[str, float]) -> StageFigures:
    """Return the figures of a stage with an entry of ONE_SIDED."""
    values = {name: value for name, value in sides.items() if name != "sensor_share"}
    um_per_v = sides["sensor_share"] * range_um
    return StageFigures(resonance_hz, damping, range_um, sensor_um_per_v=um_per_v, **values)


def stage_values(figures: StageFigures) -> dict:
    """Return the values of a stage's stage.toml."""
    return tomllib.loads(stage_files(figures)["stage.toml"])


@pytest.mark.parametrize("rate_samples", [None, 4.0, 20.0])
def test_the_loop_is_stable_with_twice_its_gain(rate_samples: float | None) -> None:
    for resonance_hz, damping, range_um in GRID:
        rate_hz = None if rate_samples is None else rate_samples * resonance_hz
        stage = stage_values(StageFigures(resonance_hz, damping, range_um, rate_hz=rate_hz))
        assert largest_pole(stage, 1.0) < 1, (resonance_hz, damping)
        assert largest_pole(stage, 2.0) < 1, (resonance_hz, damping)
        for sides in ONE_SIDED:
            stage = stage_values(one_sided_figures(resonance_hz, damping, range_um, sides))
            assert largest_pole(stage, 2.0) < 1, (resonance_hz, damping, sides)


@pytest.mark.parametrize("figures", [*GRID[::3], (310.0, 0.012, 80.0), (1.0, 0.9, 20.0)], ids=str)
def test_a_level_of_the_reference_lasts_five_settling_times_and_the_run_five_levels(
    figures: tuple[float, float, float],
) -> None:
    starter = folder.stage(StageFigures(*figures))
    values = tomllib.loads(starter.texts["stage.toml"])
    dwell_s, settled_s = values["axis"][0]["reference"]["dwell_s"], settling_s(values)
    assert 5 * settled_s < dwell_s < max(0.11, 10 * settled_s)
    (duration_s,) = (float(command.split()[-1]) for command in starter.commands if "run stage.toml" in command)
    assert duration_s >= 5 * dwell_s
    assert f"rtloop run stage.toml --duration {duration_s:g}" in starter.texts["stage.toml"]


def test_the_campaign_is_of_the_stage_and_of_a_designed_loop(tmp_path: Path) -> None:
    """A configuration with a specification is judged by it; the levels and the loop of stage.toml are the stage's."""
    texts = stage_files(StageFigures(310.0, 0.012, 80.0, drive_min_v=0.0, sensor_um_per_v=8.0, sensor_min_v=0.0))
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "designed.toml").write_text(texts["stage.toml"].replace("# specification =", "specification ="))
    own = load_campaign(tmp_path / "stage-campaign.toml")
    assert own.limits == {}
    designed = load_campaign(tmp_path / "stage-campaign.toml", configuration=tmp_path / "designed.toml")
    specified = tomllib.loads(texts["stage-spec.toml"])["specification"]
    assert designed.limits["steps.overshoot_percent"] == specified["overshoot_percent"]
    assert designed.limits["steps.settling_ms"] == specified["settling_ms"]
    case = CaseRunner(own).run(1)
    assert case.missed == ()
    assert case.figures["steps.static_error_percent"] < 0.01


def test_a_light_resonance_limits_the_gain() -> None:
    stage = stage_values(StageFigures(800.0, 0.02))
    assert largest_pole(stage, 8.0) > 1


@pytest.mark.parametrize("figures", GRID[::5], ids=str)
def test_check_finds_nothing_to_warn_of(figures: tuple[float, float, float], tmp_path: Path) -> None:
    prepared = prepare(parse(stage_files(StageFigures(*figures))["stage.toml"], "stage", tmp_path, "stage.toml"))
    assert [*prepared.warnings, *cautions(prepared)] == []
    running = prepared.checks[0].running
    assert running is not None
    assert running.stable
    assert running.gain_margin > 2
    assert running.max_sensitivity < 3


@pytest.mark.parametrize("sides", ONE_SIDED, ids=str)
@pytest.mark.parametrize("figures", GRID[::13], ids=str)
def test_a_stage_that_moves_farther_to_one_side_is_as_safe(
    figures: tuple[float, float, float], sides: dict[str, float], tmp_path: Path
) -> None:
    texts = stage_files(one_sided_figures(*figures, sides))
    for name in ("stage.toml", "stage-sine.toml", "stage-step.toml"):
        prepared = prepare(parse(texts[name], "stage", tmp_path, name))
        assert [*prepared.warnings, *cautions(prepared)] == [], name
    stage = tomllib.loads(texts["stage.toml"])
    axis, sensor = stage["axis"][0], stage["driver"]["plant"]["sensor"]
    assert axis["limits"]["command_um"] < axis["interlocks"]["position_um"] < 9.99 * sensor["um_per_v"]


@pytest.mark.parametrize("range_um", RANGES_UM)
def test_the_largest_drive_moves_the_stage_by_its_range(range_um: float) -> None:
    stage = stage_values(StageFigures(range_um=range_um, drive_v=4.0))
    for hysteresis in (stage["driver"]["plant"]["hysteresis"], stage["axis"][0]["feedforward"]):
        plays = zip(hysteresis["weights_um_per_v"], hysteresis["thresholds_v"], strict=True)
        assert sum(weight * max(0.0, 4.0 - threshold) for weight, threshold in plays) == pytest.approx(range_um, 1e-6)


def test_figures_appear_in_the_files() -> None:
    texts = stage_files(StageFigures(1234.5, 0.01, 7.0, 8.0, 0.002, 0.001, 25_000.0))
    stage, specification, sine, step, _ = (tomllib.loads(text) for text in texts.values())
    sensor = {"noise_um": 0.002, "resolution_um": 0.001}
    assert stage["driver"]["plant"]["sensor"].items() >= sensor.items()
    assert specification["sensor"] == sensor
    assert stage["loop"]["rate_hz"] == specification["controller"]["rate_hz"] == 25_000
    assert stage["axis"][0]["limits"]["drive_v"] == 8
    assert stage["driver"] == sine["driver"] == step["driver"]
    assert stage["axis"][0]["limits"] == sine["axis"][0]["limits"] == step["axis"][0]["limits"]
    for plant in (stage["driver"]["plant"]["dynamics"], stage["axis"][0]["model"], specification["plant"]):
        (_, damping_term, stiffness) = plant["denominator"][0]
        assert math.sqrt(stiffness) / (2 * math.pi) == pytest.approx(1234.5, 1e-6)
        assert damping_term / (2 * math.sqrt(stiffness)) == pytest.approx(0.01, 1e-6)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("resonance_hz", -5.0), ("resonance_hz", 20_000.0), ("damping", 1.0), ("damping", math.nan), ("range_um", 0.0),
        ("drive_v", 11.0), ("sensor_noise_um", -0.1), ("sensor_resolution_um", 5.0), ("rate_hz", 1000.0),
        ("drive_min_v", 1.0), ("drive_min_v", -12.0), ("hysteresis_percent", 31.0), ("hysteresis_percent", -1.0),
        ("sensor_um_per_v", 0.0), ("sensor_um_per_v", 0.9), ("sensor_um_per_v", math.inf),
    ],
)  # fmt: skip
def test_a_figure_out_of_range_is_refused_in_one_sentence(name: str, value: float) -> None:
    option = name.replace("_", "-")
    with pytest.raises(ValueError, match=rf"^--{option}: value is {value:g}; allowed: [^\n]+$"):
        StageFigures(**{name: value})


@pytest.mark.parametrize(
    "figures",
    [StageFigures(800.0, 0.02), StageFigures(5000.0, 0.002), StageFigures(310.0, 0.012, 80.0, drive_min_v=0.0)],
)
def test_the_specification_has_a_controller_that_meets_it(figures: StageFigures, tmp_path: Path) -> None:
    """The static error is a share of the position: of a step on a stage of one sign, it is a larger share."""
    from rtloop.design.synthesis.section import controller_values
    from rtloop.design.synthesis.specification_file import load_specification
    from rtloop.design.synthesis.synthesise import synthesise_design

    texts = stage_files(figures)
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    design = load_specification(tmp_path / "stage-spec.toml").design
    controller = controller_values(synthesise_design(design).controller, design.controller)
    section = "\n".join(f"{key} = {value!r}" for key, value in controller.items())
    ki = next(line for line in texts["stage.toml"].splitlines() if line.startswith("ki_per_s"))
    text = texts["stage.toml"].replace(f'kind = "pid"\n{ki}', section)
    running = prepare(parse(text, "stage", tmp_path, "stage.toml")).checks[0].running
    assert running is not None
    assert running.stable
    assert 1e3 * running.settling_time_s <= design.specification.settling_ms
    assert running.overshoot_percent <= design.specification.overshoot_percent
    levels_um = tomllib.loads(text)["axis"][0]["reference"]["levels"]
    smallest_step_um = min(abs(after - before) for before, after in pairwise(levels_um))
    positions_per_step = max(levels_um) / smallest_step_um
    assert running.static_error_percent * positions_per_step <= design.specification.static_error_percent


def test_a_stage_of_one_sign_is_specified_within_the_range_above_its_remanence() -> None:
    """The test steps the plays of the stage's configuration up to the largest drive and back to 0."""
    figures = StageFigures(800.0, 0.015, 90.0, 7.5, drive_min_v=0.0, hysteresis_percent=15.0, sensor_um_per_v=10.0)
    stage, specification = (tomllib.loads(stage_files(figures)[name]) for name in ("stage.toml", "stage-spec.toml"))
    plays = stage["axis"][0]["feedforward"]
    remanence_um = sum(
        weight * min(max(7.5 - threshold, 0.0), threshold)
        for weight, threshold in zip(plays["weights_um_per_v"], plays["thresholds_v"], strict=True)
    )
    room_um = stage["axis"][0]["limits"]["command_um"] - remanence_um
    assert remanence_um > 5.0
    assert 0.85 * room_um < specification["specification"]["command"]["reference_um"] < room_um


def test_gain_and_noise_of_a_data_sheet_give_the_same_stage() -> None:
    """12 µm/V up to 7.5 V are 90 µm; 1 mV of a sensor of 10 µm/V are 10 nm."""
    expected = StageFigures(range_um=90.0, drive_v=7.5, sensor_um_per_v=10.0, sensor_noise_um=0.01)
    values = {"gain_um_per_v": 12.0, "drive_v": 7.5, "sensor_um_per_v": 10.0, "sensor_noise_mv": 1.0}
    assert stage_figures(values) == expected
    assert stage_figures({"gain_um_per_v": 2.0, "sensor_noise_mv": 2.0}) == StageFigures(sensor_noise_um=0.01)
    with pytest.raises(ValueError, match="--gain-um-per-v and --range-um: the two options set the same property"):
        stage_figures({"gain_um_per_v": 2.0, "range_um": 20.0})
    with pytest.raises(ValueError, match="--sensor-noise-mv and --sensor-noise-um: the two options"):
        stage_figures({"sensor_noise_mv": 2.0, "sensor_noise_um": 0.01})


@pytest.mark.parametrize(
    ("lowest_v", "noise_um", "interlock_v"),
    [(0.0, 0.01, -0.01), (0.0, 0.1, -0.1), (-5.0, 0.01, -4.99), (None, 0.01, None)],
)
def test_the_interlock_of_the_sensor_lies_below_the_noise_at_rest(lowest_v, noise_um, interlock_v) -> None:
    figures = StageFigures(
        range_um=90.0, drive_min_v=0.0, sensor_um_per_v=10.0, sensor_noise_um=noise_um, sensor_min_v=lowest_v
    )
    for name in ("stage.toml", "stage-sine.toml", "stage-step.toml"):
        configuration = tomllib.loads(stage_files(figures)[name])
        interlocks, plant = configuration["axis"][0]["interlocks"], configuration["driver"]["plant"]
        assert interlocks.get("sensor_min_v") == (None if interlock_v is None else pytest.approx(interlock_v))
        assert plant.get("adc", {}).get("min_v") == lowest_v


def test_a_sensor_from_0_v_on_needs_a_drive_from_0_v_on() -> None:
    with pytest.raises(ValueError, match="--sensor-min-v: value is 0; allowed: -10, or -10 … 0 with --drive-min-v=0"):
        StageFigures(sensor_min_v=0.0)
