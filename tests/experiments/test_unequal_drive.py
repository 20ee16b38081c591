"""Experiments on a drive of -2 … 10 V: the whole range is used, defaults are not clipped, reductions are reported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtloop.configuration.axis import LimitsOptions
from rtloop.configuration.file import parse
from rtloop.errors import ConfigError
from rtloop.experiments.derive import derive_configuration
from rtloop.experiments.largest_amplitudes import largest_step_down, largest_step_up
from rtloop.experiments.planning import load_stage, plan_runs
from rtloop.experiments.procedure import UnsuitableLoop
from rtloop.experiments.registry import EXPERIMENTS, parse_parameters
from rtloop.experiments.report import load_runs, make_report
from rtloop.experiments.setting import Setting
from rtloop.experiments.timeline import Timeline
from rtloop.recording.load import load as load_recording
from tests.recording.real_loop import record
from tests.unequal_stage import HIGHEST_V, LOWEST_V, RATE_HZ, STAGE, Plays, curve, major_loop

BASE = parse(STAGE, "stage", Path(), "stage")


def setting(is_virgin: bool = True, **limits: float) -> Setting:
    """Return the setting of the stage with changed limits."""
    axis = BASE.axes[0]
    changed = LimitsOptions.model_validate(axis.limits.model_dump() | limits)
    return Setting(RATE_HZ, axis.model_copy(update={"limits": changed}), is_virgin)


def record_experiment(name: str, folder: Path, **options: Any) -> Path:
    """Record an experiment with its defaults, but for `options`. Returns the path."""
    experiment = EXPERIMENTS[name]
    given_options = experiment.options.model_validate(options)
    fitted = experiment.fit_options(given_options, setting())
    (run,) = experiment.runs(fitted, setting())
    reductions = experiment.reductions(given_options, setting())
    text = derive_configuration(BASE, "x", name, fitted.model_dump(mode="json"), run, 1, {}, reductions=reductions).text
    (path,) = record(folder / f"{name}.mcap", text, run.timeline.ticks)
    return path


def timeline_drive_v(timeline: Timeline) -> np.ndarray:
    """Return the drive (V) at every tick of a timeline in mode raw, by the formulas of its references."""
    parts = []
    for segment, reference in zip(timeline.segments, timeline.references, strict=True):
        assert segment.mode == "raw"
        time_s = np.arange(segment.ticks) / RATE_HZ
        if reference["kind"] == "hold":
            parts.append(np.full(segment.ticks, reference["value"]))
            continue
        angle = 2 * np.pi * reference["frequency_hz"] * time_s + np.radians(reference["phase_deg"])
        parts.append(reference["offset"] + reference["amplitude"] * np.sin(angle))
    return np.concatenate(parts)


def test_characterise_takes_the_drive_from_end_to_end_and_names_the_volts(tmp_path: Path) -> None:
    """h/H and H agree with plays that move sample by sample; no figure of a part of the range is called `whole`."""
    path = record_experiment("characterise", tmp_path, frequency_hz=4.0)
    drive_v = load_recording(path)["x_drive_v"]
    assert (drive_v.min(), drive_v.max()) == pytest.approx((LOWEST_V, HIGHEST_V), abs=0.01)
    runs = load_runs([path])
    runs[0].require_complete()
    result = EXPERIMENTS["characterise"].analyse(runs, None)
    rows = {row.quantity: row.run for row in result.rows}
    height_um, width_um = major_loop()
    assert rows["h/H, drive -2 … 10 V"] == pytest.approx(100 * height_um / width_um, abs=0.3)
    assert rows["H, drive -2 … 10 V"] == pytest.approx(width_um, rel=0.005)
    assert rows["h, drive -2 … 10 V"] == pytest.approx(height_um, rel=0.03)
    assert {"h/H, half of the drive, -1 … 5 V", "h/H, minor loop, 0 … 5 V"} <= rows.keys()
    assert not any("whole" in quantity for quantity in rows)
    assert not any("leaves out" in note for note in result.notes)


@pytest.mark.parametrize(
    ("limits", "ends"),
    [({}, (-2.0, 10.0)), ({"drive_min_v": 0.0}, (0.0, 10.0)), ({"drive_v": 2.0, "drive_min_v": -10.0}, (-10.0, 2.0)),
     ({"drive_min_v": -10.0}, (-10.0, 10.0))],
)  # fmt: skip
@pytest.mark.parametrize("cycles", [1.5, 2.0])
def test_the_drive_of_characterise_reaches_both_ends_and_never_jumps(limits, ends, cycles) -> None:
    """The fastest part is the sine of 25 Hz over the whole drive, by which an actuator with a memory is depolarised."""
    experiment = EXPERIMENTS["characterise"]
    (run,) = experiment.runs(experiment.options(cycles=cycles), setting(is_virgin=False, **limits))
    drive_v = timeline_drive_v(run.timeline)
    assert (drive_v.min(), drive_v.max()) == pytest.approx(ends, abs=1e-6)
    assert np.abs(np.diff(drive_v, prepend=0.0)).max() < 1.01 * np.pi * 25.0 * np.ptp(ends) / RATE_HZ
    major = next(segment for segment in run.timeline.segments if segment.label == "major")
    part = drive_v[major.tick_slice]
    assert (part.min(), part.max()) == pytest.approx(ends, abs=1e-6)


def test_interlocks_of_position_and_sensor_shorten_the_drive() -> None:
    """The interlock is at 36 µm, or the sensor ends at −4 and 20 µm; the oracle is the drive that moves plays there."""
    axis = BASE.axes[0].model_copy(
        update={"interlocks": BASE.axes[0].interlocks.model_copy(update={"position_um": 36.0})}
    )
    low_v, high_v = Setting(RATE_HZ, axis, is_virgin=True).drive_range_v
    assert (low_v, high_v) == pytest.approx((LOWEST_V, Plays().drive_to(36.0)), abs=0.011)
    assert curve([high_v])[0] <= 36.0
    sensor = Setting(RATE_HZ, BASE.axes[0], is_virgin=True, sensor_ends_um=(-4.0, 20.0))
    assert sensor.drive_range_v == pytest.approx((-Plays().drive_to(4.0), Plays().drive_to(20.0)), abs=0.011)


def test_the_default_amplitude_of_compensation_is_not_clipped(tmp_path: Path) -> None:
    """A default from the gain over the whole drive, 4 µm/V, would be clipped: 8 µm at -2 V; the plays reach 6.2 µm."""
    path = record_experiment("compensation", tmp_path, frequency_hz=5.0)
    (section,) = make_report(load_runs([path])).content["experiments"]
    assert section["problem"] is None
    assert section["parameters"]["amplitude_um"] == pytest.approx(-curve([LOWEST_V])[0] / 1.02, rel=0.05)
    assert section["notes"][0].startswith(
        "Reduced: compensation.amplitude_um: 6 µm (default: 40 µm), limited by axis.x.limits."
    )
    assert "drive_min_v = -2" in section["notes"][0]
    assert section["reduced"]


def test_default_steps_use_the_longer_side_without_being_clipped(tmp_path: Path) -> None:
    (run,) = load_runs([record_experiment("steps", tmp_path, dwell_s=0.05)])
    run.require_complete()
    levels_um = run.parameters["levels_um"]
    low_um = curve([HIGHEST_V, LOWEST_V])[1]
    assert max(levels_um) == 30.0
    assert low_um < min(levels_um) < 0.8 * low_um
    assert run.reductions[0].startswith("steps.levels_um: 20, 0, -4")


def test_a_step_has_room_for_its_commands_and_those_of_the_step_back() -> None:
    """The oracle is plays that follow the largest steps up and down, with overshoot, step back and undershoot."""
    stage = setting()
    model = stage.model
    assert model is not None
    assert model.step_peak is not None
    assert model.step_reversal is not None
    peak, reversal = max(model.step_peak, 1.1), max(model.step_reversal, 0.1)
    up_um, down_um = largest_step_up(stage).magnitude, largest_step_down(stage).magnitude
    commands = [(peak * up_um, -reversal * up_um), (-peak * down_um, reversal * down_um)]
    plays = Plays()
    drives_v = [plays.drive_to(command) for pair in commands for command in pair]
    assert LOWEST_V - 1e-6 <= min(drives_v) < LOWEST_V + 1e-3
    assert HIGHEST_V - 1e-3 < max(drives_v) <= HIGHEST_V + 1e-6


def test_the_step_back_limits_a_step_where_the_other_side_is_short() -> None:
    """The drive ends at -0.5 V: plays need all of it for the step back, and less than 10 V for the step itself."""
    stage = setting(drive_min_v=-0.5)
    up_um = largest_step_up(stage).magnitude
    plays = Plays()
    peak_v, back_v = plays.drive_to(1.1 * up_um), plays.drive_to(-0.1 * up_um)
    assert peak_v < 0.9 * HIGHEST_V
    assert back_v == pytest.approx(-0.5, abs=1e-6)
    assert "a step back to 0 goes beyond 0 by 0.1 times the height of the step" in largest_step_up(stage).reason


def test_equal_sides_scale_all_levels_by_one_factor() -> None:
    steps = EXPERIMENTS["steps"]
    fitted = steps.fit_options(steps.options(), setting(drive_v=3.0, drive_min_v=-3.0)).model_dump()["levels_um"]
    defaults = steps.options().model_dump()["levels_um"]
    factors = {round(level / default, 9) for level, default in zip(fitted, defaults, strict=True) if default}
    assert len(factors) == 1
    assert max(factors) < 0.5


def test_values_beyond_one_side_are_refused_with_its_limit() -> None:
    steps = EXPERIMENTS["steps"]
    allowed = steps.options(levels_um=(30.0, 0.0, -4.0))
    assert steps.fit_options(allowed, setting()) == allowed
    with pytest.raises(
        ConfigError,
        match=r"steps\.levels_um: 6 µm; allowed: up to 4\.\d+ µm, limited by axis\.x\.limits\.drive_min_v = -2",
    ):
        steps.fit_options(steps.options(levels_um=(30.0, 0.0, -6.0)), setting())


def test_a_side_without_any_room_skips_the_experiment() -> None:
    with pytest.raises(
        UnsuitableLoop, match=r"steps\.levels_um: 30 µm; allowed: up to \S+ µm, limited by axis\.x\.limits"
    ):
        EXPERIMENTS["steps"].fit_options(EXPERIMENTS["steps"].options(), setting(drive_min_v=-1e-9))


def test_the_plan_of_a_stage_stores_what_was_reduced(tmp_path: Path) -> None:
    (tmp_path / "stage.toml").write_text(STAGE, encoding="utf-8")
    stage, experiments = load_stage(tmp_path / "stage.toml", None), [EXPERIMENTS["steps"]]
    (planned,), skipped = plan_runs(experiments, parse_parameters(experiments, []), stage, tmp_path)
    assert skipped == {}
    assert '"reduced": ["steps.levels_um: ' in planned.configuration.text.partition("\n")[0]


ONE_SIDED = STAGE.replace(f"drive_min_v = {LOWEST_V}", "drive_min_v = 0.0")


def middle_um() -> float:
    """Return the middle of the positions that the plays reach in every cycle between 0 and 10 V."""
    return float(np.mean(curve([HIGHEST_V, 0.0])))


def record_one_sided(name: str, folder: Path, **options: Any) -> Path:
    """Record an experiment on a drive of 0 … 10 V, fitted and planned as the command does. Returns the path."""
    (folder / "stage.toml").write_text(ONE_SIDED, encoding="utf-8")
    stage, experiment = load_stage(folder / "stage.toml", None), EXPERIMENTS[name]
    (planned,), skipped = plan_runs([experiment], {name: experiment.options.model_validate(options)}, stage, folder)
    assert skipped == {}
    (path,) = record(folder / f"{name}.mcap", planned.configuration.text, planned.run.timeline.ticks)
    return path


@pytest.mark.parametrize("name", [name for name in EXPERIMENTS if name != "characterise"])
def test_every_experiment_moves_within_a_drive_of_one_sign(name: str) -> None:
    """Each reference in V, and the drive that plays need for each reference in µm, lies within 0 … 10 V."""
    experiment, stage = EXPERIMENTS[name], setting(drive_min_v=0.0)
    options = experiment.options(**({"resonance_percent": 0.0} if name == "scan" else {}))
    run = experiment.runs(experiment.fit_options(options, stage), stage)[-1]
    plays, ends_v = Plays(), []
    for segment, reference in zip(run.timeline.segments, run.timeline.references, strict=True):
        middle, half = reference.get("value", reference.get("offset")), reference.get("amplitude", 0.0)
        levels = reference.get("levels") or ([middle + half, middle - half] if middle is not None else [])
        if reference["kind"] == "table":
            levels = run.tables[reference["file"]][:, 0].tolist()
        if segment.label == "approach":  # a half cycle, from 0 up
            levels = levels[:1]
        ends_v += levels if segment.mode == "raw" else [plays.drive_to(level) for level in levels]
    assert min(ends_v) > -1e-6
    assert max(ends_v) < HIGHEST_V + 1e-6
    assert max(ends_v) > 4.0


def test_the_way_to_the_middle_is_slow_and_ends_there() -> None:
    stage = setting(drive_min_v=0.0)
    assert stage.middle.um == pytest.approx(middle_um(), rel=0.005)
    assert Plays().move(stage.middle.v) == pytest.approx(stage.middle.um)
    (run,) = EXPERIMENTS["harmonic"].runs(EXPERIMENTS["harmonic"].options(frequencies_hz=(1.0,)), stage)
    timeline = Timeline(RATE_HZ)
    count = next(k for k, segment in enumerate(run.timeline.segments) if segment.mode != "raw")
    timeline.segments, timeline.references = run.timeline.segments[:count], run.timeline.references[:count]
    drive_v = timeline_drive_v(timeline)
    assert drive_v[0] == pytest.approx(0.0, abs=1e-9)
    assert np.abs(np.diff(drive_v)).max() < 0.01
    assert drive_v.max() < 2 * stage.middle.v


def test_steps_on_a_drive_of_one_sign_are_analysed_about_the_middle(tmp_path: Path) -> None:
    path = record_one_sided("steps", tmp_path, dwell_s=0.05)
    signals = load_recording(path)
    assert signals["x_drive_v"].min() >= 0.0
    (section,) = make_report(load_runs([path])).content["experiments"]
    assert section["problem"] is None
    rows = {row["quantity"]: row for row in section["rows"]}
    assert rows["static error, median"]["run"] < 1.0
    assert rows["settling time to 5 %, median"]["mark"] == "good"
    assert section["middle_um"] == pytest.approx(middle_um(), rel=0.005)
    assert section["notes"][0].startswith(
        f"The drive has only one sign. Therefore the experiment moves about {section['middle_um']:g} µm"
    )
    (run,) = load_runs([path])
    for name in ("reference_um", "position_um", "command_um"):
        assert run.signal(name) + section["middle_um"] == pytest.approx(signals[f"x_{name}"])
    assert run.signal("drive_v") == pytest.approx(signals["x_drive_v"])


def test_compensation_on_a_drive_of_one_sign_agrees_with_its_model(tmp_path: Path) -> None:
    """The rig has the plays of the inverse, so that neither the rig nor the model has hysteresis left."""
    path = record_one_sided("compensation", tmp_path, frequency_hz=4.0)
    (section,) = make_report(load_runs([path])).content["experiments"]
    assert section["problem"] is None
    rows = {row["quantity"]: row for row in section["rows"]}
    low_um, high_um = sorted(curve([HIGHEST_V, 0.0]))
    assert section["parameters"]["amplitude_um"] > 0.9 * (high_um - low_um) / 2 / 1.02
    assert rows["largest |v − y|"]["model"] < 0.01
    assert rows["h/H after compensation"]["model"] < 0.01
    assert rows["ρ, slope of y over v"]["run"] == pytest.approx(1.0, abs=0.01)


def test_the_model_of_a_compensation_remembers_how_an_actuator_was_depolarised(tmp_path: Path) -> None:
    """The inverse of the rig's plays is exact; a model that begins at rest has an error of 0.7 µm."""
    base, experiment = parse(ONE_SIDED, "stage", Path(), "stage"), EXPERIMENTS["compensation"]
    stage = Setting(RATE_HZ, base.axes[0], is_virgin=False)
    options = experiment.fit_options(experiment.options(amplitude_um=5.0, frequency_hz=4.0), stage)
    (run,) = experiment.runs(options, stage)
    text = derive_configuration(base, "x", "compensation", options.model_dump(mode="json"), run, 1, {}).text
    (path,) = record(tmp_path / "depolarised.mcap", text, run.timeline.ticks)
    rows = {row.quantity: row for row in experiment.analyse(load_runs([path]), options).rows}
    error = rows["largest |v − y|"]
    assert error.model == pytest.approx(error.run, abs=0.1)
