"""The actuator of `rtloop init --kind stage` and its excitations, against plays stepped in numpy and scipy."""

from __future__ import annotations

import itertools
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lsim

import rtloop
from rtloop.starters.stage import stage_actuator, stage_files
from rtloop.starters.stage_figures import StageFigures

ONE_SIDED_STAGE = StageFigures(
    800.0, 0.02, 40.0, sensor_noise_um=0.002, drive_min_v=-2.0, hysteresis_percent=12.0, sensor_um_per_v=4.0
)
"""A stage from −2 V to +10 V, whose sensor ends where its travel ends."""
LOWEST_V, PERCENT, SENSOR_UM_PER_V = (None, -2.0, 0.0), (None, 0.0, 12.0, 30.0), (None, 4.0, 2.2)
FIGURES = [
    StageFigures(800.0, 0.02, 40.0, drive_min_v=lowest, hysteresis_percent=percent, sensor_um_per_v=scale)
    for lowest, percent, scale in itertools.product(LOWEST_V, PERCENT, SENSOR_UM_PER_V)
]
FIGURES += [
    StageFigures(
        800.0, 0.015, 90.0, 7.5, drive_min_v=0.0, hysteresis_percent=percent, sensor_um_per_v=10.0, sensor_min_v=0.0
    )
    for percent in (0.0, 15.0, 30.0)
]
SENSOR_END_V = 9.99


def stage_values(figures: StageFigures, name: str) -> dict:
    """Return the values of the file `name` of a stage."""
    return tomllib.loads(stage_files(figures)[name])


def simulate_plays(values: dict, drive_v: np.ndarray) -> np.ndarray:
    """Return the positions (µm) of the actuator from rest, by play operators stepped sample by sample."""
    hysteresis = values["driver"]["plant"]["hysteresis"]
    position_um = np.zeros(drive_v.size)
    for weight, threshold in zip(hysteresis["weights_um_per_v"], hysteresis["thresholds_v"], strict=True):
        output = 0.0
        for k, drive in enumerate(drive_v):
            output = min(max(output, drive - threshold), drive + threshold)
            position_um[k] += weight * output
    return position_um


@pytest.mark.parametrize("lowest_v", [None, -2.0, 0.0])
@pytest.mark.parametrize("percent", [0.0, 5.0, 12.0, 30.0])
def test_the_loop_is_as_wide_as_its_option_says(lowest_v: float | None, percent: float) -> None:
    values = stage_values(
        StageFigures(range_um=33.0, drive_v=9.0, drive_min_v=lowest_v, hysteresis_percent=percent), "stage.toml"
    )
    low_v = -9.0 if lowest_v is None else lowest_v
    rising_v = np.linspace(low_v, 9.0, 1801)
    first_v = np.linspace(0.0, 9.0, 901)
    position_um = simulate_plays(values, np.concatenate([first_v, rising_v[::-1], rising_v]))
    falling_um, rising_um = position_um[901:2702][::-1], position_um[2702:]
    assert position_um[900] == pytest.approx(33.0, rel=1e-5)
    assert falling_um[0] == pytest.approx(rising_um[0], abs=1e-9)
    stroke_um = rising_um[-1] - rising_um[0]
    assert 100 * np.max(falling_um - rising_um) / stroke_um == pytest.approx(percent, abs=2e-3)


@pytest.mark.parametrize("limit_um", [1.0, 5.0, 12.0, 19.0])
def test_the_drives_within_a_limit_reach_it_on_both_sides(limit_um: float) -> None:
    figures = StageFigures(hysteresis_percent=25.0)
    lowest_v, highest_v = stage_actuator(figures).drives_within(limit_um)
    drive_v = np.concatenate([np.linspace(0, highest_v, 500), np.linspace(highest_v, lowest_v, 1000)])
    position_um = simulate_plays(stage_values(figures, "stage.toml"), drive_v)
    assert position_um.max() == pytest.approx(limit_um, abs=1e-5)
    assert position_um.min() == pytest.approx(-limit_um, abs=1e-5)


@pytest.mark.parametrize(
    "figures", FIGURES, ids=lambda f: f"{f.drive_min_v} {f.hysteresis_percent} {f.sensor_um_per_v}"
)
def test_both_excitations_stay_within_drive_and_sensor(figures: StageFigures) -> None:
    low_v = -10.0 if figures.drive_min_v is None else figures.drive_min_v
    sine, step = stage_values(figures, "stage-sine.toml"), stage_values(figures, "stage-step.toml")
    reference = sine["axis"][0]["reference"]
    phase = np.radians(reference["phase_deg"]) + 2 * np.pi * np.linspace(0, 2.5, 5001)
    drive_v = reference["offset"] + reference["amplitude"] * np.sin(phase)
    assert abs(drive_v[0]) < 1e-6
    assert low_v - 1e-6 <= drive_v.min()
    assert drive_v.max() <= figures.drive_v + 1e-6
    sensor_um = SENSOR_END_V * sine["driver"]["plant"]["sensor"]["um_per_v"]
    end_um = min(sine["axis"][0]["interlocks"]["position_um"], sensor_um)
    reached_um = np.abs(simulate_plays(sine, drive_v)).max()
    assert reached_um < end_um
    is_full_range = drive_v.max() > figures.drive_v - 0.01 and drive_v.min() < low_v + 0.01
    assert is_full_range or reached_um > 0.9 * end_um  # not smaller than necessary

    step_v = step["schedule"][0]["reference"]["value"]
    assert 0 < step_v <= 10
    low_step_v = step["schedule"][1]["reference"]["value"]
    up_down_um = simulate_plays(step, np.repeat([step_v, low_step_v], 4000))
    (_, damping_term, stiffness) = step["driver"]["plant"]["dynamics"]["denominator"][0]
    _, swing_um, _ = lsim(([stiffness], [1.0, damping_term, stiffness]), up_down_um, np.arange(8000) * 2e-5)
    reached_um = np.abs(swing_um).max()
    assert reached_um < end_um
    assert figures.sensor_min_v is None or swing_um.min() > -1e-6
    assert (low_step_v > 0) == (figures.sensor_min_v is not None)
    assert step_v > 9.99 or reached_um > 0.85 * end_um


def test_a_one_sided_stage_runs_and_is_recorded_without_a_trip(tmp_path: Path) -> None:
    for name, text in stage_files(ONE_SIDED_STAGE).items():
        (tmp_path / name).write_text(text)
    for name, duration_s in (("stage", 1.5), ("stage-sine", 25.0), ("stage-step", 1.0)):
        result = rtloop.run(tmp_path / f"{name}.toml", duration_s=duration_s, unpaced=True, folder=tmp_path)
        assert (result.outcome, result.trips) == ("done", []), name
        run = result.recording
        assert run is not None
        assert run["x_drive_v"].min() > -2.000001
        assert run["x_drive_v"].max() > 5
        if name == "stage":
            values = tomllib.loads((tmp_path / "stage.toml").read_text())
            dwell_ticks = values["axis"][0]["reference"]["dwell_s"] * values["loop"]["rate_hz"]
            ends = np.arange(2, 7) * int(dwell_ticks) - 10  # The first level is entered by a glide.
            assert np.allclose(run["x_position_um"][ends], run["x_reference_um"][ends], atol=0.2)
