"""Experiments of a campaign on a stage whose drive has one sign move about its middle, and never beyond its reach."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from rtloop.campaigns.campaign_file import load_campaign
from rtloop.campaigns.case import CaseRunner
from rtloop.campaigns.recorded_case import has_ticks, record_rig
from rtloop.campaigns.rig_experiments import POINTS, Motion
from rtloop.configuration.reference_options import HoldOptions, StepsOptions, WaveOptions
from rtloop.errors import ConfigError
from rtloop.starters.stage import stage_files
from rtloop.starters.stage_figures import StageFigures
from tests.campaigns.campaign_files import PAPER, write_campaign
from tests.command_line import run
from tests.recording.forging import pack_file, take_apart

SCAN = '[[experiment]]\nkind = "scan"\namplitude_um = 20.0\nfrequency_hz = 0.5\nperiods = 2.0\n'
PUSH = '[[experiment]]\nkind = "disturbance"\nstep_um = -2.0\n'
KEY = '"driver.plant.dynamics.damping_factor" = { uniform = [0.9, 1.1] }'
RISE_UM, LARGEST_COMMAND_UM, TICK_CHANNEL = 80.0, 75.164, 1


def campaign(folder: Path, experiments: str, configuration: Path | None = None) -> CaseRunner:
    """Return the runner of a campaign without limits, by default on a stage of 0 … 80 µm for 0 … 10 V."""
    if configuration is None:
        figures = StageFigures(310.0, 0.012, RISE_UM, sensor_um_per_v=8.0, drive_min_v=0.0, sensor_min_v=0.0)
        configuration = folder / "one-sided.toml"
        configuration.write_text(stage_files(figures)["stage.toml"])
    path = write_campaign(folder, "rigs = 1", KEY, experiments, configuration=configuration)
    path.write_text(path.read_text().partition("[limits]")[0])
    return CaseRunner(load_campaign(path))


def test_a_scan_and_a_disturbance_are_about_the_middle(tmp_path: Path) -> None:
    runner = campaign(tmp_path, SCAN + PUSH)
    wave, hold = (experiment.reference for experiment in runner.options.experiment)
    assert isinstance(wave, WaveOptions)
    assert isinstance(hold, HoldOptions)
    # 0 V after 75 µm leaves a few µm: the middle of what is left is a little above half of 75.164 µm.
    assert LARGEST_COMMAND_UM / 2 < wave.offset == hold.value < LARGEST_COMMAND_UM / 2 + 5
    case = runner.run(0)
    assert case.trips == {"scan": "", "disturbance": ""}
    # The error of an integrator at a ramp of 40 µm/s is 40/ki, with ki = 2ζω/3 = 15.6/s; a scan about 0 misses 20 µm.
    assert case.figures["scan.error_peak_um"] == pytest.approx(40 / (2 * 0.012 * 2 * math.pi * 310 / 3), rel=0.05)
    assert case.figures["disturbance.error_peak_um"] < 4.2  # 2 µm, with the overshoot of a lightly damped stage


@pytest.mark.parametrize(
    ("experiment", "message"),
    [
        (f"{SCAN}offset_um = 0.0\n", "experiment.scan: reference: reaches -20 µm, beyond the end of the sensor's"),
        (SCAN.replace("20.0", "38.0"), "experiment.scan: reference: reaches 7"),
        (f"{PUSH}hold_um = 79.0\n", "reaches 79 µm, beyond limits.command_um = 75.164. Use other levels"),
        ('[[experiment]]\nkind = "steps"\nlevels_um = [40.0, 0.0]\n', "the drive's limits, 0 V … 10 V, allow only"),
    ],
)
def test_a_reference_beyond_reach_is_refused_before_it_runs(tmp_path: Path, experiment: str, message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        campaign(tmp_path, experiment)
    assert message in str(raised.value)


def test_the_rest_before_the_first_step_is_no_level_to_come_back_to(tmp_path: Path) -> None:
    runner = campaign(tmp_path, '[[experiment]]\nkind = "steps"\nlevels_um = [40.0, 20.0]\ndwell_s = 1.0\n')
    assert runner.run(0).figures["steps.static_error_percent"] < 0.1


@pytest.mark.parametrize(
    ("line", "configuration", "overshoot_percent"),
    [("", None, 5.0), ("first_step = true\n", None, 20.0), ("", PAPER, 20.0), ("first_step = false\n", PAPER, 5.0)],
)
def test_the_step_from_the_end_of_a_drive_counts_on_request_alone(
    tmp_path: Path, line: str, configuration: Path | None, overshoot_percent: float
) -> None:
    """The first step, of 10 µm, swings over by 2 µm; the second, of 4 µm, by 0.2 µm."""
    steps = f'[[experiment]]\nkind = "steps"\nlevels_um = [10.0, 6.0]\ndwell_s = 0.01\n{line}'
    (experiment,) = campaign(tmp_path, steps, configuration).options.experiment
    reference = experiment.reference
    assert isinstance(reference, StepsOptions)
    assert reference.levels == ((0.0 if overshoot_percent == 20.0 else 10.0), 10.0, 6.0)
    position_um = np.repeat([0.0, 12.0, 10.0, 5.8, 6.0], [100, 20, 80, 20, 80])
    motion = Motion(np.repeat([0.0, 10.0, 6.0], 100), np.tile(position_um[:, None], POINTS), 10_000.0)
    assert experiment.measure(motion)[0] == pytest.approx(overshoot_percent)


@pytest.mark.parametrize("cycles", [1, 2])
def test_the_only_step_counts_always(tmp_path: Path, cycles: int) -> None:
    lines = f"levels_um = [10.0]\ncycles = {cycles}\ndwell_s = 0.01\nfirst_step = false\n"
    steps = f'[[experiment]]\nkind = "steps"\n{lines}'
    (experiment,) = campaign(tmp_path, steps, None).options.experiment
    position_um = np.repeat([0.0, 12.0, 10.0], [100, 20, 100 * cycles - 20])
    motion = Motion(np.repeat([0.0, 10.0], [100, 100 * cycles]), np.tile(position_um[:, None], POINTS), 10_000.0)
    assert experiment.measure(motion)[0] == pytest.approx(20.0)


def test_a_scan_of_both_signs_stays_about_0(tmp_path: Path) -> None:
    (experiment,) = campaign(tmp_path, SCAN, PAPER).options.experiment
    reference = experiment.reference
    assert isinstance(reference, WaveOptions)
    assert (reference.offset, reference.phase_deg) == (0.0, 0.0)


def test_a_recording_without_ticks_is_named_and_recorded_again(tmp_path: Path) -> None:
    runner = campaign(tmp_path, PUSH)
    (path,) = record_rig(runner, 0, tmp_path / "worst")
    base = take_apart(path)
    path.write_bytes(pack_file(base._replace(chunks=[c for c in base.chunks if c.channels != (TICK_CHANNEL,)])))
    assert not has_ticks(path)
    row = run("archive", "info", tmp_path / "worst")
    assert row.exit_code == 1
    assert "the recording has no tick" in " ".join(row.stdout.split())
    record_rig(runner, 0, tmp_path / "worst")
    assert has_ticks(path)
