"""The design chain on strictly proper random rigs (forty in tests.soak.chain) and on the documentation's stage."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rtloop.cli import main
from rtloop.configuration.file import Configuration, load
from rtloop.configuration.prepare import prepare
from rtloop.design import palette as theme
from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.synthesis.specification_file import load_specification
from rtloop.experiments.derive import derive_configuration
from rtloop.experiments.registry import EXPERIMENTS
from rtloop.experiments.report import load_runs, make_report
from rtloop.experiments.setting import Setting
from tests.design.modal_rigs import modal_rig
from tests.recording.real_loop import record
from tests.soak.chain import LIMITS, design_rig, run, verdict

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
ONE_MODE_LATE_BY_3, TWO_MODES_LATE_BY_1 = 14, 38


@pytest.mark.parametrize("seed", [ONE_MODE_LATE_BY_3, TWO_MODES_LATE_BY_1])
def test_a_rig_drawn_at_random_gets_a_loop_that_runs(tmp_path, seed) -> None:
    """The rig's modes and delay are identified; the loop meets its specification on the model, and runs on the rig."""
    rig = modal_rig(seed)
    chain, written = design_rig(rig, tmp_path)
    assert chain.stage.dynamics.delay_ticks == rig.delay_ticks > 0
    light_hz = sorted(mode.frequency_hz for mode in chain.stage.dynamics.modes if mode.damping < 0.1)
    assert light_hz == pytest.approx(rig.hz, rel=1e-3)
    assert verdict(chain) == "meets it"
    running = prepare(load(written)).checks[0].running
    assert running is not None
    assert running.delay_ticks == rig.delay_ticks
    trips, distances = run(written, running)
    assert trips == []
    assert all(abs(distances[name]) <= limit for name, limit in LIMITS.items()), distances


@pytest.mark.usefixtures("few_simulated_steps")
def test_the_stage_of_ones_own_keeps_its_specification(tmp_path, monkeypatch) -> None:
    """deploy/own-stage*.toml, as docs/identification.md walks through them: every command ends with 0."""
    recordings = [
        record(tmp_path / f"{name}.mcap", (DEPLOY / f"{name}.toml").read_text(encoding="utf-8"), ticks)[0]
        for name, ticks in (("own-stage-sine", 25_000), ("own-stage", 10_000))
    ]
    out = tmp_path / "my-stage.toml"
    arguments = [*recordings, "--specs", DEPLOY / "own-stage-spec.toml", "--out", out, "--json"]
    result = CliRunner().invoke(main, ["design", "auto", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["meets"]
    assert f"[axis.reference] of {out}: steps between 5 and 0 µm, 0.1 s each" in result.stderr
    assert "without any controller" not in out.read_text(encoding="utf-8")
    (axis,) = load(out).axes
    assert axis.model is not None
    assert axis.model.delay_ticks == 1
    assert axis.interlocks.oscillation_swings > 0
    trips, _ = run(out, prepare(load(out)).checks[0].running)
    assert trips == []
    monkeypatch.setattr(theme, "THEMES", {"light": theme.LIGHT})  # one of the two themes is enough for this test
    _check_experiment_reports(load(out), tmp_path)


EXPERIMENT_OPTIONS: dict[str, dict[str, object]] = {
    "characterise": {"frequency_hz": 1.0},
    "step-response": {},
    "compensation": {},
    "steps": {},
    "sines": {},
    "harmonic": {"frequencies_hz": (0.5, 5.0, 60.0, 790.0, 800.0, 810.0, 1200.0)},
    "disturbance": {},
}
"""Options that shorten the experiments; all experiments but robustness, which is run as a command."""


def _check_experiment_reports(made: Configuration, folder: Path) -> None:
    """Check that experiments compare the stage with its specification and models, and that defaults fit its limits."""
    specification = load_specification(DEPLOY / "own-stage-spec.toml").design.specification
    stage = Setting(made.loop.rate_hz, made.axes[0], is_virgin=True, specification=specification)
    values = specification.model_dump(mode="json", exclude_defaults=True)
    files = []
    for name, raw_options in EXPERIMENT_OPTIONS.items():
        experiment = EXPERIMENTS[name]
        options = experiment.fit_options(experiment.options.model_validate(raw_options), stage)
        runs = experiment.runs(options, stage)
        for number, planned_run in enumerate(runs):
            text = derive_configuration(
                made, "x", name, options.model_dump(mode="json"), planned_run, len(runs), values
            ).text
            files += record(folder / f"{name}-{number}.mcap", text, planned_run.timeline.ticks)
    recorded_runs = load_runs(files)
    content = make_report(recorded_runs).content
    assert not any(word in json.dumps(content, ensure_ascii=False).lower() for word in ("paper", "eq (", "fig "))
    rows = {row["quantity"]: row for section in content["experiments"] for row in section["rows"]}
    assert {section["problem"] for section in content["experiments"]} == {None}
    assert rows["settling time to 5 %, median"]["asked"] == "≤ 6 ms"
    assert rows["settling time to 5 %, median"]["met"]
    assert rows["remaining error at 2.9 Hz"]["met"]
    assert rows["remaining error at 50 Hz"]["met"] is None  # the specification ends at 5 Hz
    disturbed = [recorded_run for recorded_run in recorded_runs if recorded_run.experiment == "disturbance"]
    curves = EXPERIMENTS["disturbance"].analyse(disturbed, options).curves  # `options` are those of the last experiment
    assert curves["time_ms"] == pytest.approx(0.1 * np.arange(1500))  # 150 ms of ticks of 0.1 ms, from the step on
    assert 0.0 < curves["time_ms"][np.abs(curves["step"]).argmax()] < 10.0
    for quantity in (
        "frequency of the ringing", "overshoot", "final position", "remaining error at 1 Hz", "h/H, drive ±10 V",
        "H, drive ±10 V", "frequency of the peak without control", "height of the peak over low frequencies",
    ):  # fmt: skip
        assert rows[quantity]["as_the_model"], rows[quantity]


def test_no_loop_is_designed_on_a_model_that_explains_nothing(tmp_path) -> None:
    """A model with one pole cannot describe two modes."""
    with pytest.raises(
        UnsuitableData, match=r"no model explains the step. The best model has order 1, .* Use a step up and down"
    ):
        design_rig(modal_rig(TWO_MODES_LATE_BY_1), tmp_path, order=1)
