"""The rigs of a campaign: their values, and their figures against a simulation by python-control."""

from __future__ import annotations

import math
from pathlib import Path

import control
import numpy as np
import pytest

import rtloop
import rtloop.campaigns.rig_builder
from rtloop.campaigns.campaign_file import load_campaign
from rtloop.campaigns.case import CaseRunner
from rtloop.campaigns.recorded_case import record_rig
from rtloop.errors import ConfigError
from tests.campaigns.campaign_files import ROOT, STEPS, UNCERTAIN, write_campaign
from tests.campaigns.campaign_files import rtloop as command
from tests.paper_dynamics import paper_dynamics

OTHER_EXPERIMENTS = """
[[experiment]]
kind = "sine"
amplitude_um = 5.0
frequency_hz = 50.0
periods = 3.0
[[experiment]]
kind = "scan"
amplitude_um = 5.0
frequency_hz = 50.0
periods = 3.0
[[experiment]]
name = "push"
kind = "disturbance"
step_um = 2.0
hold_um = 4.0
start_s = 0.2
lasts_s = 0.05
"""


@pytest.fixture
def runner(tmp_path):
    """The runner of a campaign with all kinds of experiments."""
    return CaseRunner(load_campaign(write_campaign(tmp_path, experiments=STEPS + OTHER_EXPERIMENTS)))


def test_the_nominal_rig_is_the_configured_one(runner):
    values = runner.run(0).values
    assert values == {
        "driver.seed": 1,
        "driver.plant.dynamics.resonance_shift": 0.0,
        "driver.plant.dynamics.damping_factor": 1.0,
        "driver.plant.dynamics.gain_factor": 1.0,
    }


def test_a_rig_twice_is_equal_and_another_rig_is_not(runner):
    first, repeated, other_case = runner.run(7), runner.run(7), runner.run(8)
    assert first == repeated
    assert set(first.figures.values()).isdisjoint(other_case.figures.values())
    assert first.values.keys() == other_case.values.keys()
    assert set(map(str, first.values.values())).isdisjoint(map(str, other_case.values.values()))


def true_motion(recording: Path, points: int, pushed_um: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return reference and true position of a recording, at and between ticks, simulated by python-control.

    The recorded hysteresis drives eq (5) of the paper, held over each period and sampled `points` times as fast. From
    tick 2000 on, a disturbance of `pushed_um` is added to the hysteresis.
    """
    samples = rtloop.load(recording)
    actuator_um = samples["x_hysteresis_um"]
    inputs_um = np.append(actuator_um[1:], actuator_um[-1])
    inputs_um[2000:] += pushed_um
    inputs = np.repeat(inputs_um, points)
    fine = control.c2d(paper_dynamics(), 1e-4 / points, "zoh")
    return samples["x_reference_um"], np.asarray(control.forced_response(fine, inputs=inputs).outputs).reshape(
        -1, points
    )


def test_figures_are_those_of_the_recorded_motion_between_ticks(runner, tmp_path):
    """The nominal rig is eq (5) of the paper, which python-control simulates from the recorded hysteresis."""
    case = runner.run(0)
    steps, sine, scan, push = (
        true_motion(path, 8, 2.0 if "push" in path.name else 0.0) for path in record_rig(runner, 0, tmp_path / "worst")
    )
    reference_um, position_um = steps
    after_um = position_um[300:].ravel()
    level_um = after_um[-after_um.size // 5 :].mean()
    outside = np.flatnonzero(np.abs(after_um - level_um) > 0.5)
    oracle = {
        "steps.overshoot_percent": 100 * (after_um.max() - level_um) / 10.0,
        "steps.settling_ms": (outside[-1] + 1) / 80.0,
        "steps.static_error_percent": 100 * abs(level_um - 10.0) / 10.0,
    }
    for name, (reference_um, position_um) in {"sine": sine, "scan": scan, "push": push}.items():
        first = 2000 if name == "push" else 200
        between_um = np.interp(np.arange(reference_um.size * 8) / 8, np.arange(reference_um.size), reference_um)
        error_um = (between_um.reshape(-1, 8) - position_um)[first:]
        oracle |= {
            f"{name}.error_rms_um": math.sqrt(np.mean(error_um**2)),
            f"{name}.error_peak_um": np.abs(error_um).max(),
        }
    outside = np.flatnonzero(np.abs(error_um.ravel()) > 0.05 * 2.0)
    oracle["push.settling_ms"] = (outside[-1] + 1) / 80.0
    assert case.figures == pytest.approx(oracle, rel=1e-6, abs=1e-9)


def test_the_recording_of_a_rig_replays_and_rings_at_its_resonance(runner, tmp_path):
    (path, *_) = record_rig(runner, 3, tmp_path / "worst")
    process = command("replay", path, folder=tmp_path)
    process.communicate(timeout=100)
    assert process.returncode == 0
    samples = rtloop.load(path)
    position_um = samples["x_true_position_um"]
    overshoot_percent = 100 * (position_um[300:].max() - position_um[-60:].mean()) / 10.0
    assert runner.run(3).figures["steps.overshoot_percent"] == pytest.approx(overshoot_percent, rel=0.03)


def test_a_value_that_is_not_applied_is_found(runner, monkeypatch):
    """The test drops one key before it reaches the rig; no rig may run with a value other than its result names."""
    replace = rtloop.campaigns.rig_builder.replace_values

    def drop_one(tables, values):
        return replace(tables, {key: value for key, value in values.items() if "damping" not in key})

    monkeypatch.setattr("rtloop.campaigns.rig_builder.replace_values", drop_one)
    with pytest.raises(RuntimeError, match=r"damping_factor: the campaign set \S+, but the rig that runs has 1.0"):
        runner.run(4)


def test_an_unstable_rig_trips_and_fails(tmp_path):
    campaign = load_campaign(
        write_campaign(tmp_path, uncertain='"driver.plant.dynamics.resonance_shift" = { uniform = [0.05, 0.06] }',
                       experiments=STEPS.replace("0.03", "0.3"))
    )  # fmt: skip
    case = CaseRunner(campaign).run(1)
    assert case.trips == {"steps": "oscillation"}
    assert not case.has_passed
    assert math.isinf(case.ratio)
    assert "steps tripped: oscillation" in case.missed


def test_keys_of_the_law_build_another_law(tmp_path):
    campaign = load_campaign(
        write_campaign(tmp_path, uncertain='"axis.x.controller.gain" = { uniform = [0.5, 0.9], relative = true }')
    )
    runner = CaseRunner(campaign)
    nominal, rig = runner.run(0), runner.run(1)
    assert 0.008 <= rig.values["axis.x.controller.gain"] <= 0.0144
    assert rig.figures["steps.settling_ms"] != nominal.figures["steps.settling_ms"]


def test_a_rig_that_is_impossible_is_refused_by_name(tmp_path):
    campaign = load_campaign(
        write_campaign(tmp_path, uncertain='"driver.plant.dynamics.resonance_shift" = { uniform = [-1.1, 0.0] }')
    )
    runner = CaseRunner(campaign)
    refusals = [case.refusal for case in map(runner.run, range(1, 40))]
    assert any("resonance_shift" in refusal and "greater than or equal to -0.9" in refusal for refusal in refusals)
    assert any(not refusal for refusal in refusals)


@pytest.mark.parametrize(
    ("uncertain", "message"),
    [
        ('"driver.plant.dynamics.resonance" = { uniform = [0.0, 1.0] }', "no key 'resonance'; allowed: form, gain"),
        ('"recording.min_free_mib" = { uniform = [1.0, 2.0] }', "run alike; remove the key"),
        ('"driver.plant.hysteresis.weights_um_per_v.0" = { uniform = [1.0, 2.0] }', "weights_um_per_v"),
        ('"driver.kind" = { choice = ["sim", "shm"] }', "driver.kind: this key cannot be uncertain"),
        ('"driver.plant.disturbance.step_um" = { uniform = [1.0, 2.0] }', "experiment 'push' sets the disturbance"),
        ('"driver.plant.sensor.noise_um" = { uniform = [-2.0, -1.0] }', "greater than or equal to 0"),
        ('"driver.plant.hysteresis.truth" = { choice = ["nominal", "residual"], relative = true }', "allowed: numbers"),
    ],
)
def test_a_key_without_effect_or_sense_is_an_error(tmp_path, uncertain, message):
    with pytest.raises(ConfigError) as raised:
        CaseRunner(load_campaign(write_campaign(tmp_path, uncertain=uncertain, experiments=STEPS + OTHER_EXPERIMENTS)))
    assert message in str(raised.value)
    assert "uncertain." in str(raised.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"keys": 'axis = "y"'}, "axis: 'y' is unknown; allowed: x"),
        ({"keys": "rigs = 0"}, "rigs"),
        (
            {"experiments": STEPS.replace('kind = "steps"', "")},
            "experiment.0.kind: missing; allowed: 'steps', 'sine', 'scan', 'disturbance'",
        ),
        ({"experiments": STEPS + STEPS}, "two experiments have the name 'steps'"),
        (
            {"experiments": STEPS.replace("[10.0]", "[0.0]")},
            "a first level other than 0, and each further level different from the level before",
        ),
        ({"limits": '"steps.settling" = 3.0'}, "steps.settling; allowed: steps.overshoot_percent, steps.settling_ms"),
        ({"uncertain": ""}, "uncertain"),
        ({"configuration": ROOT / "deploy/board.toml"}, "a campaign needs the simulated rig"),
    ],
)
def test_a_campaign_that_cannot_run_is_refused_with_its_faults(tmp_path, changes, message):
    with pytest.raises(ConfigError) as raised:
        CaseRunner(load_campaign(write_campaign(tmp_path, **changes)))
    assert message in str(raised.value)


def test_all_keys_together_have_an_effect(runner):
    names = list(runner.keys)
    assert names == [line.split('"')[1] for line in UNCERTAIN.strip().splitlines()]


@pytest.mark.parametrize("dwell_s", [0.0124, 0.01236, 0.01234])
def test_a_dwell_of_no_whole_number_of_periods_keeps_all_steps(tmp_path, dwell_s):
    """Each level lasts a whole number of periods: after 100 cycles the last step is as long as the first."""
    steps = STEPS.replace("[10.0]", "[10.0, 0.0]").replace("dwell_s = 0.03", f"dwell_s = {dwell_s}\ncycles = 100")
    case = CaseRunner(load_campaign(write_campaign(tmp_path, experiments=steps))).run(0)
    assert case.figures["steps.settling_ms"] <= 1000 * dwell_s + 0.1
    assert case.figures["steps.overshoot_percent"] < 20.0


@pytest.mark.parametrize(
    ("experiment", "message"),
    [
        (STEPS.replace("0.03", "1e-5"), "experiment.steps: "),
        ('[[experiment]]\nkind = "sine"\namplitude_um = 1.0\nfrequency_hz = 6000.0\n', "below half of the loop's rate"),
        (
            '[[experiment]]\nkind = "sine"\namplitude_um = 1.0\nfrequency_hz = 100.0\nperiods = 1.001\n',
            "experiment.sine: ",
        ),
        ('[[experiment]]\nkind = "disturbance"\nstep_um = 1.0\nlasts_s = 1e-5\n', "experiment.disturbance: "),
    ],
)
def test_an_experiment_that_no_rig_can_run_is_a_fault_of_the_campaign(tmp_path, experiment, message):
    path = write_campaign(tmp_path, experiments=experiment)
    path.write_text(path.read_text().partition("[limits]")[0])
    with pytest.raises(ConfigError) as raised:
        CaseRunner(load_campaign(path))
    assert message in str(raised.value)


def test_a_limit_of_0_ranks_rigs_by_the_figure(tmp_path):
    path = write_campaign(tmp_path)
    path.write_text(path.read_text().replace('"steps.overshoot_percent" = 20.0', '"steps.overshoot_percent" = 0.0'))
    case = CaseRunner(load_campaign(path)).run(0)
    assert case.ratio == 1.0 + case.figures["steps.overshoot_percent"]


def test_every_entry_of_a_choice_is_tried_before_the_first_rig(tmp_path):
    with pytest.raises(ConfigError, match=r"adc\.bits: 13\.5"):
        CaseRunner(
            load_campaign(
                write_campaign(tmp_path, uncertain='"driver.plant.adc.bits" = { choice = [12, 13.5, 14, 15, 16] }')
            )
        )


def test_a_key_without_a_value_in_the_configuration_can_be_uncertain(tmp_path):
    uncertain = (
        '"axis.x.limits.slew_v_per_s" = { uniform = [1e4, 2e4] }\n'
        '"driver.plant.sensor.bandwidth_hz" = { uniform = [2e3, 4e3] }'
    )
    runner = CaseRunner(load_campaign(write_campaign(tmp_path, uncertain=uncertain)))
    assert runner.run(0).values["axis.x.limits.slew_v_per_s"] is None
    assert 1e4 <= runner.run(1).values["axis.x.limits.slew_v_per_s"] <= 2e4
