"""The procedures of experiments: derived configurations, fitted defaults, verdicts, and measured responses."""

from __future__ import annotations

import re
import shutil
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from scipy import signal

from rtloop.analysis.margins import loop_margins
from rtloop.cli import main
from rtloop.configuration.axis import AxisOptions, ModelOptions
from rtloop.configuration.file import load, parse
from rtloop.configuration.prepare import prepare
from rtloop.configuration.simulated import sensor_ends_um, sensor_reach_um
from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.synthesis.specification import ClaimOptions, DisturbanceOptions, SpecificationOptions
from rtloop.design.verification.judgement import Limit
from rtloop.errors import ConfigError
from rtloop.experiments.derive import derive_configuration, read_metadata, store_tables
from rtloop.experiments.planning import load_stage, plan_runs
from rtloop.experiments.procedures.harmonic import bandwidth_hz
from rtloop.experiments.procedures.response import ResponseOptions, analyse
from rtloop.experiments.procedures.robustness import Outcome, next_shift_distance, range_about_zero, settling_range
from rtloop.experiments.procedures.step_response import StepResponseOptions, fit_ringing
from rtloop.experiments.procedures.step_response import analyse as analyse_step
from rtloop.experiments.registry import EXPERIMENTS, parse_parameters, select_experiments
from rtloop.experiments.report import load_runs, make_report
from rtloop.experiments.setting import Setting
from rtloop.experiments.timeline import Segment
from rtloop.experiments.verdict import Row
from rtloop.foundation.options import Options
from rtloop.recording.load import load as load_recording
from tests.command_line import answer
from tests.experiments.test_linear_model import JUMPING_LAW
from tests.recording.real_loop import record

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
PAPER = load(DEPLOY / "paper.toml")
RATE_HZ = 10_000.0


def setting(virgin: bool = True) -> Setting:
    """Return the setting of the paper's loop; its actuator has a memory if it is not virgin."""
    return Setting(PAPER.loop.rate_hz, PAPER.axes[0], virgin)


def default_options(name: str) -> Options:
    """Return default options; for a scan, without a shift of the resonance, at which the paper's loop cannot learn."""
    return EXPERIMENTS[name].options(**({"resonance_percent": 0.0} if name == "scan" else {}))


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_run_is_a_configuration_that_can_be_prepared(name: str, tmp_path: Path) -> None:
    options = default_options(name)
    run = EXPERIMENTS[name].runs(options, setting())[-1]
    store_tables(run, tmp_path)
    plan = prepare(
        derive_configuration(PAPER, "x", name, options.model_dump(mode="json"), run, 1, {}), paced=False
    ).plan
    assert plan.mode.name.lower() == run.timeline.segments[0].mode
    assert len(plan.schedule) >= len(run.timeline.segments) - 1


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_limits_and_interlocks_stay_unchanged(name: str) -> None:
    base = tomllib.loads(PAPER.text)
    for run in EXPERIMENTS[name].runs(default_options(name), setting()):
        derived = tomllib.loads(derive_configuration(PAPER, "x", name, {}, run, 1, {}).text)
        for part in ("limits", "interlocks", "feedforward", "controller", "model"):
            assert derived["axis"][0][part] == base["axis"][0][part]
        assert derived["driver"]["channels"] == base["driver"]["channels"]
        assert derived["loop"]["rate_hz"] == base["loop"]["rate_hz"]


def test_segments_follow_each_other_without_a_gap() -> None:
    for experiment in EXPERIMENTS.values():
        for run in experiment.runs(default_options(experiment.name), setting(virgin=False)):
            ends = [segment.start_tick + segment.ticks for segment in run.timeline.segments]
            assert [segment.start_tick for segment in run.timeline.segments] == [0, *ends[:-1]]


def test_an_actuator_with_a_memory_is_depolarised_first() -> None:
    options = EXPERIMENTS["steps"].options()
    (run,) = EXPERIMENTS["steps"].runs(options, setting(virgin=False))
    first = run.timeline.references[:100]
    assert [reference["amplitude"] for reference in first] == pytest.approx(np.arange(10.0, 0.05, -0.1))
    assert run.timeline.segments[99].mode == "raw"
    assert run.timeline.segments[100].mode == "closed_loop"


def test_a_derived_configuration_describes_its_run() -> None:
    (run,) = EXPERIMENTS["compensation"].runs(EXPERIMENTS["compensation"].options(), setting())
    metadata = read_metadata(
        derive_configuration(PAPER, "x", "compensation", {"cycles": 2.0}, run, 1, {"settling_ms": 3.0}).text
    )
    assert metadata["name"] == "compensation"
    assert metadata["parameters"] == {"cycles": 2.0}
    assert metadata["asked"] == {"settling_ms": 3.0}
    assert metadata["segments"][1][:4] == ["sine", "feedforward", 1000, 200_000]
    assert read_metadata(PAPER.text) is None
    assert read_metadata("# rtloop experiment {") is None


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("steps.dwell=1", "steps.dwell: unknown key; did you mean dwell_s"),
        ("steps.dwell_s=0", "steps.dwell_s: 0"),
        ("steps.dwell_s", "allowed: EXPERIMENT.KEY=VALUE"),
        ("harmonic.amplitude_um=1", "with an EXPERIMENT from steps"),
        ("steps.levels_um=much", "'much'; allowed: a number"),
    ],
)
def test_wrong_parameters_are_named(setting: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_parameters([EXPERIMENTS["steps"]], [setting])


def test_parameters_and_names() -> None:
    options = parse_parameters(select_experiments(["sines", "steps"]), ["steps.levels_um=[1, 2.5]"])
    assert options["steps"].model_dump()["levels_um"] == (1.0, 2.5)
    assert [experiment.name for experiment in select_experiments(["sines", "steps"])] == ["steps", "sines"]
    with pytest.raises(ConfigError, match=r"'step' is not an experiment"):
        select_experiments(["step"])


@pytest.mark.parametrize(
    ("run", "limit", "claim", "model", "verdict", "mark"),
    [
        (5.0, 6.0, (4.0, 6.0), 5.1, "meets the requirement, as claimed, as the model", "good"),
        (5.0, 6.0, (6.0, 7.0), 9.0, "meets the requirement, not as claimed, off the model by -4 V", "mixed"),
        (5.0, 4.0, (4.0, 6.0), 5.1, "MISSES the requirement, as claimed, as the model", "bad"),
        (np.float64(5.0), 4.0, None, np.float64(5.1), "MISSES the requirement, as the model", "bad"),
        (5.0, None, (4.0, None), None, "as claimed", "good"),
        (5.0, None, (None, 4.0), None, "not as claimed", "mixed"),
        (5.0, None, (None, None), 9.0, "off the model by -4 V", "mixed"),
        (5.0, None, None, 5.1, "as the model", "good"),
        (5.0, None, None, np.nan, "", ""),
        (np.nan, 6.0, (4.0, 6.0), 5.0, "no value in this run", ""),
        (5.0, None, None, None, "", ""),
    ],
)
def test_a_verdict_answers_for_specification_claim_and_model(
    run: float, limit: float | None, claim: tuple[float | None, float | None] | None, model: float | None,
    verdict: str, mark: str,
) -> None:  # fmt: skip
    """Only a missed requirement has the mark `bad`."""
    requirement = None if limit is None else Limit(limit, at_most=True)
    claimed = None if claim is None else ClaimOptions(says="so", at_least=claim[0], at_most=claim[1])
    row = Row("q", "V", run, model, 0.2, requirement, claimed)
    assert (row.verdict, row.mark) == (verdict, mark)


def test_the_ringing_of_a_known_system_is_found() -> None:
    omega, zeta = 2 * np.pi * 412.0, 0.0123
    time_s = np.arange(2000) / RATE_HZ
    _, x = signal.step(signal.lti([omega**2], [1, 2 * zeta * omega, omega**2]), T=time_s)
    ringing = fit_ringing(40 * x + np.random.default_rng(1).normal(0, 0.01, x.size), RATE_HZ)
    assert ringing.frequency_hz == pytest.approx(412.0, abs=0.05)
    assert ringing.damping == pytest.approx(zeta, rel=0.01)
    assert ringing.level == pytest.approx(40.0, abs=0.01)


@pytest.mark.parametrize(
    ("height", "rate_hz", "ticks"),
    [
        (np.ones(100), 200.0, "in 17 ticks"),
        (np.ones(100), 5.0, "in 0 ticks"),
        (np.zeros(2000), RATE_HZ, "ticks that contain"),
    ],
)
def test_a_window_without_ringing_is_named(height: np.ndarray, rate_hz: float, ticks: str) -> None:
    """A slow loop has too few ticks in the window, or none; a stage at rest has no ringing."""
    with pytest.raises(UnsuitableData, match=f"no ringing found .*{ticks}"):
        fit_ringing(height, rate_hz)


def test_bandwidth_of_a_first_order_lag() -> None:
    hz = np.geomspace(0.01, 1000, 200)
    magnitude = -10 * np.log10(1 + (hz / 50) ** 2)
    assert bandwidth_hz(np.stack([hz, magnitude], axis=1)) == pytest.approx(50.0, rel=0.01)
    assert np.isnan(bandwidth_hz(np.stack([hz, 0 * hz], axis=1)))


def test_the_range_of_shifts_ends_at_the_first_that_does_not_settle() -> None:
    trip = {"tick": 1, "causes": ["oscillation"]}
    outcomes = [Outcome(shift, 2.0 if shift == -6 else 0.1, 20.0, trip if shift == 5 else None) for shift in
                (-9, -6, -3, 0, 2, 5)]  # fmt: skip
    assert settling_range(outcomes) == (-3, 2)
    assert np.isnan(settling_range([Outcome(0.0, 9.0, 20.0, None)])).all()


def test_predicted_ranges_and_their_tolerance() -> None:
    assert range_about_zero({-5.0: False, -2.0: True, 0.0: True, 3.0: True, 4.0: False, 5.0: True}) == (-2, 3)
    assert next_shift_distance(-2.0, (-5.0, -2.0, 0.0, 1.0), is_downward=True) == 3.0
    assert next_shift_distance(1.0, (-5.0, -2.0, 0.0, 1.0), is_downward=False) == 0.0


SMALL = PAPER.axes[0].model_copy(
    update={"limits": PAPER.axes[0].limits.model_copy(update={"command_um": 20.0, "drive_min_v": -6.0})}
)


def test_the_papers_amplitudes_fit_the_papers_limits() -> None:
    for experiment in EXPERIMENTS.values():
        fitted, defaults = experiment.fit_options(experiment.options(), setting()), experiment.options()
        for key in type(defaults).model_fields:
            assert getattr(fitted, key) == getattr(defaults, key) or getattr(defaults, key) is None


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_default_amplitudes_follow_the_limits(name: str) -> None:
    """References in V lie within the limits of the drive, references in µm within the limit of the command."""
    experiment, stage = EXPERIMENTS[name], Setting(RATE_HZ, SMALL, is_virgin=False)
    for run in experiment.runs(experiment.fit_options(default_options(name), stage), stage):
        for segment, reference in zip(run.timeline.segments, run.timeline.references, strict=True):
            value = reference.get("value", reference.get("offset", 0.0))
            ends = (value - reference.get("amplitude", 0.0), value + reference.get("amplitude", 0.0))
            lowest, highest = (-6.0, 10.0) if segment.mode == "raw" else (-20.0, 20.0)
            assert lowest <= min(ends) <= max(ends) <= highest, (segment.label, reference)


def test_values_set_beyond_the_limits_are_refused() -> None:
    steps, stage = EXPERIMENTS["steps"], Setting(RATE_HZ, SMALL, is_virgin=True)
    with pytest.raises(
        ConfigError, match=r"_um: 15 µm; allowed: up to 14\.32 µm, limited by axis\.x\.limits\.command_um"
    ):
        steps.fit_options(steps.options(levels_um=(0.0, -15.0)), stage)
    allowed = steps.options(levels_um=(0.0, -14.0))
    assert steps.fit_options(allowed, stage) == allowed


@pytest.mark.parametrize("smaller", ["compared", "own"])
def test_compared_configurations_share_the_smaller_defaults(smaller: str, tmp_path: Path) -> None:
    """Commands of 30 and 20 µm; a step's command is at least 1.1 times its height, so that 18 µm fit both."""
    limits = ("20.0", "30.0") if smaller == "own" else ("30.0", "20.0")
    robust, stages = (DEPLOY / "robust.toml").read_text(encoding="utf-8"), []
    for name, limit in zip(("own", "compared"), limits, strict=True):
        path = tmp_path / f"{name}.toml"
        path.write_text(re.sub(r"(?m)^command_um = \S+", f"command_um = {limit}", robust))
        shutil.copy(DEPLOY / "robust-spec.toml", tmp_path)
        stages.append(load_stage(path, "x"))
    experiments, folder = [EXPERIMENTS["steps"]], tmp_path / "runs"
    runs, _ = plan_runs(experiments, parse_parameters(experiments, []), stages[0], folder, compared=stages[1])
    fitted = {planned.experiment.name: planned.options for planned in runs}
    compared_runs, skipped = plan_runs(experiments, fitted, stages[1], folder, is_comparison=True)
    for (planned,) in (runs, compared_runs):
        levels = [segment.values["level_um"] for segment in planned.run.timeline.segments[1:]]
        assert max(levels) == pytest.approx(18.0)
    assert skipped == {}
    too_large = parse_parameters(experiments, ["steps.levels_um=[20.0]"])
    with pytest.raises(ConfigError) as refused:
        plan_runs(experiments, too_large, stages[0], folder, compared=stages[1])
    message = str(refused.value)
    assert "steps.levels_um: 20 µm; allowed: up to 18.18 µm, limited by axis.x.limits.command_um" in message
    assert ("of the second configuration (--beside)" in message) is (smaller == "compared")


def test_a_configuration_that_is_not_compared_changes_no_default(tmp_path: Path) -> None:
    """The second configuration has no controller, so that it makes no steps, and its limits do not count."""
    experiments = [EXPERIMENTS["steps"]]
    stages = [load_stage(path, "x") for path in (DEPLOY / "paper.toml", DEPLOY / "own-stage.toml")]
    (planned,), _ = plan_runs(experiments, parse_parameters(experiments, []), stages[0], tmp_path, compared=stages[1])
    assert planned.options == experiments[0].options()


STAGE = (
    load(DEPLOY / "own-stage.toml")
    .axes[0]
    .model_copy(update={"model": ModelOptions(gain=25266187.0, denominator=((1.0, 201.06193, 25266187.0),))})
)
"""A stage with a resonance at 800 Hz that overshoots by 94 %; the full drive moves it by 20 µm, and 45 µm trip."""


@pytest.mark.parametrize("axis", [PAPER.axes[0], SMALL, STAGE], ids=["paper", "small", "stage"])
@pytest.mark.parametrize("name", [name for name, experiment in EXPERIMENTS.items() if experiment.limits])
def test_the_named_limit_is_the_one_that_binds(name: str, axis: AxisOptions) -> None:
    """The reason has the value of the configured limit, and half of this limit allows less."""
    (bound_of_setting,) = EXPERIMENTS[name].limits.values()
    bound = bound_of_setting(Setting(RATE_HZ, axis, is_virgin=True))
    match = re.match(r"(limits|interlocks)\.(\w+) = (\S+)", bound.reason)
    assert match is not None, bound
    section, key, value = getattr(axis, match[1]), match[2], float(match[3])
    assert getattr(section, key) == pytest.approx(value)
    if bound.magnitude == 1.0:  # a part of drive_v itself
        return
    halved = axis.model_copy(update={match[1]: section.model_copy(update={key: value / 2})})
    assert bound_of_setting(Setting(RATE_HZ, halved, is_virgin=True)).magnitude < 0.8 * bound.magnitude


def test_a_scan_stays_within_the_range_of_the_sensor() -> None:
    """10 µm/V and 1.9 V at the sensor's interlock, 0.1 V of offset: 18 µm to one side, and 20 µm to the other one."""
    text = (DEPLOY / "robust.toml").read_text(encoding="utf-8")
    for old, new in (("sensor_min_v = -9.99", "sensor_min_v = -1.9"), ("sensor_max_v = 9.99", "sensor_max_v = 1.9")):
        assert old in text
        text = text.replace(old, new)
    base = parse(
        text.replace("um_per_v = 10.0\n", "um_per_v = 10.0\noffset = 0.1\n", 1), "robust", DEPLOY, "robust.toml"
    )
    (axis,) = base.axes
    stage = Setting(RATE_HZ, axis, True, sensor_um=sensor_reach_um(base, axis))
    scan = EXPERIMENTS["scan"]
    with pytest.raises(
        ConfigError,
        match=r"sensor_min_v = -1\.9 and sensor_max_v = 1\.9 \(for a motion about 0 the sensor's range ends at 18 µm",
    ):
        scan.fit_options(scan.options(amplitude_um=19.0), stage)
    assert scan.fit_options(scan.options(), stage).model_dump()["amplitude_um"] <= 18.0


@pytest.mark.parametrize(("offset_v", "scale", "ends"), [
    (0.0, 10.0, (0.0, 80.0)), (3.0, 10.0, (-30.0, 50.0)), (3.0, -5.0, (-25.0, 15.0)),
])  # fmt: skip
def test_the_sensors_range_moves_with_a_tare_and_turns_with_the_sign(offset_v, scale, ends) -> None:
    """Readings from 0 V to 8 V."""
    text = (DEPLOY / "robust.toml").read_text(encoding="utf-8")
    for old, new in (("sensor_min_v = -9.99", "sensor_min_v = 0.0"), ("sensor_max_v = 9.99", "sensor_max_v = 8.0")):
        text = text.replace(old, new)
    base = parse(text.replace("um_per_v = 10.0\n", f"um_per_v = {scale}\n", 1), "robust", DEPLOY, "robust.toml")
    assert sensor_ends_um(base, base.axes[0], offset_v) == pytest.approx(ends)


def test_a_light_resonance_is_not_driven_into_the_interlock() -> None:
    """Without control, the response at 800 Hz is 25 times as large, and a step nearly reaches twice its height."""
    stage = Setting(RATE_HZ, STAGE, is_virgin=True)
    swept = EXPERIMENTS["harmonic"].fit_options(EXPERIMENTS["harmonic"].options(), stage).model_dump()
    assert 0.7 <= swept["amplitude_um"] <= 20.0 / 25.0
    near = [hz for hz in swept["frequencies_hz"] if abs(hz / 800.0 - 1) < 0.01]
    assert len(near) >= 4
    assert max(swept["frequencies_hz"]) <= 0.4 * RATE_HZ
    stiff = STAGE.model_copy(update={"interlocks": STAGE.interlocks.model_copy(update={"position_um": 30.0})})
    part = EXPERIMENTS["step-response"].fit_options(
        EXPERIMENTS["step-response"].options(), Setting(RATE_HZ, stiff, is_virgin=True)
    )
    assert part.model_dump()["part_of_drive"] * 20.0 * (1 + np.exp(-0.02 * np.pi)) < 30.0


def test_the_disturbance_is_that_of_the_specification() -> None:
    specification = SpecificationOptions(disturbance=DisturbanceOptions(largest_um=1.5, error_um=0.1))
    stage = Setting(RATE_HZ, PAPER.axes[0], is_virgin=True, specification=specification)
    experiment = EXPERIMENTS["disturbance"]
    options = experiment.fit_options(experiment.options(), stage)
    assert options.model_dump()["amplitude_um"] == 1.5
    assert experiment.runs(options, stage)[0].plant["disturbance"]["step_um"] == 1.5


def test_a_unipolar_amplifier_excludes_no_experiment() -> None:
    limits = PAPER.axes[0].limits.model_copy(update={"drive_min_v": 0.0})
    axis = PAPER.axes[0].model_copy(update={"limits": limits})
    suitable = [
        experiment.name
        for experiment in EXPERIMENTS.values()
        if experiment.unsuitable_reason(PAPER, axis, is_rig=True) is None
    ]
    assert suitable == list(EXPERIMENTS)


def test_a_clipped_run_is_not_judged(tmp_path: Path) -> None:
    """A sine of 40 µm is clipped at 20 µm: the run is recorded, but not analysed."""
    experiment = EXPERIMENTS["compensation"]
    options = experiment.options(amplitude_um=40.0, frequency_hz=5.0)
    (run,) = experiment.runs(options, Setting(RATE_HZ, PAPER.axes[0], is_virgin=True))
    text = derive_configuration(PAPER, "x", experiment.name, options.model_dump(mode="json"), run, 1, {}).text
    problems = []
    for name, limit in (("clipped", "command_um = 20.0"), ("free", "command_um = 42.0")):
        (path,) = record(tmp_path / f"{name}.mcap", text.replace("command_um = 42.0", limit), run.timeline.ticks)
        (section,) = make_report(load_runs([path])).content["experiments"]
        problems.append(section["problem"])
    assert problems[1] is None
    assert "the command was clipped in" in problems[0]
    assert "not analysed" in problems[0]


LINEAR = (('truth = "residual"', 'truth = "nominal"'), ('dead_band = "none"', 'dead_band = "exact"'))
"""Changes that give the rig the actuator of the inverse, without a dead band: the loop is then linear."""
LATENCY = ("latency_ticks = 0", "latency_ticks = 2")


def record_response(folder: Path, *changes: tuple[str, str]) -> tuple[Path, ResponseOptions]:
    """Record the experiment `response` on the paper's rig with changes. Returns its recording and its options."""
    text = PAPER.text
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    base = parse(text, "response", PAPER.folder, "test")
    options = ResponseOptions(period_s=0.5, periods=3)
    (run,) = EXPERIMENTS["response"].runs(options, Setting(RATE_HZ, base.axes[0], is_virgin=True))
    derived_text = derive_configuration(base, "x", "response", options.model_dump(mode="json"), run, 1, {}).text
    (path,) = record(folder / "response.mcap", derived_text, run.timeline.ticks)
    return path, options


@pytest.fixture(scope="module")
def linear_response(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ResponseOptions]:
    """Recording and options of the experiment `response` on the linear loop."""
    return record_response(tmp_path_factory.mktemp("linear"), *LINEAR)


def test_the_measured_margins_are_those_of_the_model_on_a_rig_that_is_as_the_model(
    linear_response: tuple[Path, ResponseOptions],
) -> None:
    path, options = linear_response
    (section,) = make_report(load_runs([path])).content["experiments"]
    assert section["problem"] is None
    assert "hysteresis remains" not in " ".join(section["notes"])
    rows = {row["quantity"]: row["run"] for row in section["rows"]}
    assert rows["gain margin"] == pytest.approx(2.566, rel=0.02)
    assert rows["phase margin"] == pytest.approx(73.05, abs=2.0)
    assert rows["resonance"] == pytest.approx(595.50, rel=0.0006)
    assert rows["largest |S|"] == pytest.approx(1.654, rel=0.02)
    position_um = load_recording(path)["x_true_position_um"]
    assert 0.1 < np.abs(position_um).max() <= options.amplitude_um


def test_the_models_margins_are_those_of_a_rig_with_latency(tmp_path: Path) -> None:
    """[axis.model] states no delay: without the rig's, its gain margin would be 2.566, and its phase margin 73.05°."""
    path, _ = record_response(tmp_path, *LINEAR, LATENCY)
    (section,) = make_report(load_runs([path])).content["experiments"]
    rows = {row["quantity"]: row for row in section["rows"]}
    assert rows["gain margin"]["model"] == pytest.approx(rows["gain margin"]["run"], rel=0.02)
    assert rows["phase margin"]["model"] == pytest.approx(rows["phase margin"]["run"], abs=2.0)
    assert rows["largest |S|"]["model"] == pytest.approx(rows["largest |S|"]["run"], rel=0.02)
    assert rows["gain margin"]["run"] > 3.0
    assert rows["phase margin"]["run"] < 68.0


def test_a_plan_counts_on_the_margins_that_check_promises(tmp_path: Path) -> None:
    config = tmp_path / "late.toml"
    assert LATENCY[0] in PAPER.text
    config.write_text(PAPER.text.replace(*LATENCY))
    shutil.copy(DEPLOY / "paper-spec.toml", tmp_path)
    promised = answer("check", config)["axes"][0]["running"]
    planned = load_stage(config, "x").setting.model.loop
    assert loop_margins(planned).gain_margin == pytest.approx(promised["gain_margin"])
    assert loop_margins(planned).phase_margin_deg == pytest.approx(promised["phase_margin_deg"])


def test_a_law_that_is_not_linear_is_planned_without_its_loop(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(JUMPING_LAW)
    shutil.copy(DEPLOY / "paper-spec.toml", tmp_path)
    begin, end = PAPER.text.index("[axis.controller]"), PAPER.text.index("[axis.model]")
    config = tmp_path / "lab.toml"
    config.write_text(PAPER.text[:begin] + '[axis.controller]\nfile = "mine.py"\n' + PAPER.text[end:])
    experiments = select_experiments(["steps", "response", "scan"])
    stage = load_stage(config, "x")
    assert "the law is not smooth at rest" in " ".join(stage.prepared.warnings)
    runs, skipped = plan_runs(experiments, parse_parameters(experiments, []), stage, tmp_path / "runs")
    assert [planned.experiment.name for planned in runs] == ["steps", "response"]
    assert "the controller cannot be linearised" in skipped["scan"]


def test_hysteresis_that_is_left_is_said_of_measured_margins(tmp_path: Path) -> None:
    """The paper's inverse leaves hysteresis, which moves the gain margin far off the linear loop's 2.566."""
    path, _ = record_response(tmp_path)
    (section,) = make_report(load_runs([path])).content["experiments"]
    rows = {row["quantity"]: row["run"] for row in section["rows"]}
    assert abs(rows["gain margin"] / 2.566 - 1) > 0.1
    assert "hysteresis remains, so that the stage is not linear in this motion" in " ".join(section["notes"])
    result = CliRunner().invoke(main, ["identify", "response", str(path)])
    assert "hysteresis remains" in " ".join(result.stdout.split())


def test_a_position_that_moves_further_than_stated_is_refused(linear_response: tuple[Path, ResponseOptions]) -> None:
    """A motion up to the stated amplitude plus REST_MARGIN times the motion at rest is allowed."""
    path, options = linear_response
    (run,) = load_runs([path])
    position_um = load_recording(path)["x_position_um"]
    multisine, rest_segment = run.segments_labelled("multisine")[0], run.segments_labelled("rest")[-1]
    moving, resting = position_um[multisine.tick_slice], position_um[rest_segment.tail_slice(rest_segment.ticks // 2)]
    moving = moving[round(options.period_s * RATE_HZ) :]
    moved_um, rest_um = np.abs(moving - moving.mean()).max(), np.abs(resting - resting.mean()).max()
    for surplus, is_refused in ((1.1, False), (1.3, True)):
        amplitude_um = moved_um - surplus * rest_um
        stated = options.model_copy(update={"amplitude_um": amplitude_um})
        if not is_refused:
            assert analyse([run], stated).rows
            continue
        with pytest.raises(UnsuitableData, match=f"moved by {moved_um:.3g} µm; .* Use a smaller amplitude_um"):
            analyse([run], stated)


class FallingStage:
    """Stand-in for a run of the step experiment on a stage whose position rings, multiplied by `sign`."""

    rate_hz, model = 10_000.0, None
    axis_options = SimpleNamespace(limits=SimpleNamespace(drive_v=10.0))

    def __init__(self, sign: float) -> None:
        time_s = np.arange(20_000) / self.rate_hz
        step = 1.0 - np.exp(-40.0 * time_s) * np.cos(2 * np.pi * 500.0 * time_s)
        self.position = sign * np.concatenate([np.zeros(10_000), 10.0 * step])

    def signal(self, _: str) -> np.ndarray:
        return self.position

    def segments_labelled(self, label: str) -> list[Segment]:
        return [Segment(label, "raw", 0, 10_000, {}) if label == "rest" else Segment(label, "raw", 10_000, 20_000, {})]

    def row(self, _name: str, quantity: str, unit: str, run: float, *_: object) -> tuple[str, str, float]:
        return quantity, unit, run


def test_a_stage_that_falls_as_its_drive_rises_has_the_overshoot_of_its_mirror_image():
    rising, falling = (
        {quantity: run for quantity, _, run in analyse_step([FallingStage(sign)], StepResponseOptions()).rows}
        for sign in (1.0, -1.0)
    )
    assert rising["overshoot"] == pytest.approx(95.9, abs=1.0)
    assert falling == pytest.approx(rising | {"final position": -rising["final position"]})
