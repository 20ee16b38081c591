"""Campaigns with the lateness of a recorded run: positions between late ticks are simulated by python-control."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import control
import numpy as np
import pytest

import rtloop
from rtloop.campaigns.campaign_file import Campaign, load_campaign
from rtloop.campaigns.case import CaseRunner
from rtloop.campaigns.recorded_case import record_rig
from rtloop.campaigns.recorded_lateness import recorded_lateness, reduce_samples
from rtloop.campaigns.rig_experiments import POINTS
from rtloop.configuration.rig import true_positions
from rtloop.drivers.sim import SimDriver
from rtloop.engine.in_process import run_in_process
from rtloop.errors import ConfigError
from rtloop.recording.errors import RecordingError
from rtloop.recording.replay.replay import replay
from tests.campaigns.campaign_files import PAPER, STEPS, write_campaign
from tests.engine.harness import AXIS, CONTROLLER, IDEAL, make_plan, text
from tests.engine.test_late_clock import simulate
from tests.paper_dynamics import paper_dynamics

pytestmark = pytest.mark.system

SINE = '[axis.reference]\nkind = "sine"\namplitude = 10.0\nfrequency_hz = 50.0\n'
LATE_US = (0.0, 30.0, 60.0, 90.0, 120.0, 250.0)
PUSH = "[driver.plant.disturbance]\nstep_um = 2.0\nsine_um = 1.0\nsine_hz = 30.0\nstart_s = 0.02\n"
CREEP = "[driver.plant.creep]\ngains = [0.05]\ntime_constants_s = [0.01]\n"


def late_run(ticks: int, driver_keys: str = "") -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the columns of a run with missed periods, and the positions at and between ticks computed from them."""
    configuration = text(IDEAL, driver_keys, AXIS, CONTROLLER, SINE)
    configuration = configuration.replace("[driver]", f"simulated_lateness_us = {[*LATE_US]}\n[driver]", 1)
    plan = make_plan(configuration)
    driver = cast("SimDriver", plan.driver())
    coefficients, state = driver.rig
    at_rest = coefficients, state.copy()
    columns = dict(zip(plan.columns, run_in_process(plan, driver, ticks).T, strict=True))
    return columns, true_positions(driver, at_rest, "x", columns, POINTS)


@pytest.mark.parametrize("driver_keys", ["", PUSH])
def test_positions_computed_at_ticks_are_the_recorded_ones_in_bits(driver_keys):
    columns, position_um = late_run(3000, driver_keys)
    assert columns["periods_missed"].sum() > 1000
    assert np.ptp(position_um) > 10
    assert position_um[:, 0].tobytes() == columns["x_true_position_um"].tobytes()


def test_positions_between_ticks_are_those_of_python_control():
    """Eq (5) on a grid POINTS times as fine, its input held through the missed periods; each row begins at its tick."""
    columns, position_um = late_run(2000)
    index = np.arange(2000) + np.cumsum(columns["periods_missed"].astype(int))
    displacement_um = np.append(columns["x_hysteresis_um"][1:], columns["x_hysteresis_um"][-1])
    every_um = np.append(np.zeros(index[0]), np.repeat(displacement_um, np.append(np.diff(index), 1)))
    fine = control.c2d(paper_dynamics(), 1e-4 / POINTS, "zoh")
    oracle_um = simulate(fine, np.repeat(every_um, POINTS)).reshape(-1, POINTS)[index]
    # The input passes directly to the output, so that the first point of a period has the input after the tick.
    np.testing.assert_allclose(position_um[:, 1:], oracle_um[:, 1:], atol=1e-8 * np.ptp(oracle_um))


def make_campaign(folder: Path, lateness_us: tuple[float, ...], keys: str = "", **changes: Any) -> Campaign:
    """Return a campaign whose rigs draw their lateness from `lateness_us`."""
    return replace(load_campaign(write_campaign(folder, keys, **changes)), lateness_us=lateness_us)


def test_each_rig_draws_lateness_of_its_own_and_the_same_each_time(tmp_path):
    runner = CaseRunner(make_campaign(tmp_path, (0.0, 110.0, 20.0, 210.0)))
    first, repeated, other_case = runner.run(2), runner.run(2), runner.run(3)
    assert first == repeated
    assert not first.refusal
    on_time = CaseRunner(make_campaign(tmp_path, ()))
    assert first.values == on_time.run(2).values
    assert first.figures != on_time.run(2).figures
    (path,), (other_path,) = (record_rig(runner, rig, tmp_path / "worst") for rig in (2, 3))
    recording, other_recording = rtloop.load(path), rtloop.load(other_path)
    assert other_case.values != first.values
    assert not np.array_equal(recording["lateness_us"], other_recording["lateness_us"])
    assert np.unique(np.round(recording["lateness_us"], 6)).tolist() == [0.0, 10.0, 20.0]
    assert np.unique(recording["periods_missed"]).tolist() == [0, 1, 2]


def test_the_recording_of_a_rig_has_its_motion_and_replays_identical(tmp_path):
    """The recording's process draws the same lateness, so that its static error equals the figure."""
    runner = CaseRunner(make_campaign(tmp_path, (*50 * (0.0,), 110.0, 310.0)))
    case = runner.run(4)
    (path,) = record_rig(runner, 4, tmp_path / "worst")
    recording = rtloop.load(path)
    assert recording["periods_missed"].sum() > 0
    position_um = recording["x_true_position_um"][-60:]
    assert case.figures["steps.static_error_percent"] == pytest.approx(
        100 * abs(position_um.mean() - 10.0) / 10.0, abs=0.05
    )
    assert replay(recording).identical


def test_lateness_below_a_period_changes_no_figure(tmp_path):
    late, on_time = (CaseRunner(make_campaign(tmp_path, table_us)).run(1) for table_us in ((0.0, 99.0), ()))
    assert late == on_time


@pytest.mark.parametrize("key", ['"driver.latency_ticks" = { choice = [1, 2] }', None])
def test_rigs_whose_motion_in_missed_periods_is_unknown_are_refused(tmp_path, key):
    """A delayed drive, or creep, moves the actuator in missed periods, which have no record."""
    configuration = tmp_path / "creep.toml"
    paper = PAPER.read_text().replace('"paper-spec.toml"', f'"{PAPER.with_name("paper-spec.toml")}"', 1)
    configuration.write_text(paper.replace("[driver.plant.sensor]", f"{CREEP}[driver.plant.sensor]", 1))
    changes: dict[str, Any] = {"uncertain": key} if key else {"configuration": configuration}
    case = CaseRunner(make_campaign(tmp_path, (0.0, 250.0), **changes)).run(1)
    assert "a rig with driver.latency_ticks = 0, without creep and without the fault drive_lost" in case.refusal
    assert not CaseRunner(make_campaign(tmp_path, (0.0, 90.0), **changes)).run(1).refusal


def test_the_digest_has_the_numbers_and_not_the_path(tmp_path):
    on_time, late, other_table = (make_campaign(tmp_path, table_us) for table_us in ((), (1.0, 2.0), (1.0, 3.0)))
    assert len({campaign.digest for campaign in (on_time, late, other_table)}) == 3
    renamed = replace(late, options=late.options.model_copy(update={"lateness": "moved.mcap"}))
    assert renamed.digest == late.digest


def run_paced(folder: Path, *arguments: str) -> Path:
    """Run the paper's loop for half a second by the command line; return its recording."""
    command = [sys.executable, "-m", "rtloop", "run", PAPER, "--duration", "0.5", "--out", folder, "--json", *arguments]
    process = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=200)
    assert process.returncode in (0, 1), process.stderr  # a busy host may be so late that the loop trips
    return Path(json.loads(process.stdout)["recording"])


def test_a_campaign_reads_the_lateness_of_a_paced_recording(tmp_path):
    path = run_paced(tmp_path)
    recording = rtloop.load(path)
    lateness_us, missed_us = recording["lateness_us"], 100.0 * recording["periods_missed"]
    counted_us = [0.0, *(max(late - 100.0, 0.0) for late in lateness_us[:-1])]
    late_us = np.sort(lateness_us + [max(a - b, 0.0) for a, b in zip(missed_us, counted_us, strict=True)])
    assert late_us.size == 5000
    campaign = load_campaign(write_campaign(tmp_path, f'lateness = "{path.name}"'))
    drawn_us = np.array(campaign.lateness_us)
    assert drawn_us.size == 4096
    assert drawn_us[[0, -1]] == pytest.approx(late_us[[0, -1]], abs=6e-4)
    shares = np.linspace(0, 1, 33)
    np.testing.assert_allclose(
        np.quantile(drawn_us, shares, method="nearest"),
        np.quantile(late_us, shares, method="nearest"),
        atol=6e-4 + np.diff(late_us)[:-50].max(),
        rtol=0.05,
    )
    case = CaseRunner(campaign).run(1)
    assert not case.refusal
    assert campaign.digest != load_campaign(write_campaign(tmp_path)).digest


@pytest.mark.parametrize("count", [1, 2, 4095, 4096, 4097, 5000, 8192, 100_003])
def test_reduced_samples_keep_every_quantile_and_both_ends(count):
    ordered = np.sort(np.random.default_rng(count).pareto(1.0, count))
    reduced = reduce_samples(ordered, 4096)
    assert reduced.size == min(count, 4096)
    assert reduced[[0, -1]].tolist() == ordered[[0, -1]].tolist()
    ranks = np.searchsorted(ordered, reduced)
    expected = np.linspace(0, count - 1, reduced.size)
    assert np.abs(ranks - expected).max() <= 0.5


def test_a_recording_without_lateness_is_refused_by_name(tmp_path):
    path = run_paced(tmp_path, "--unpaced")
    with pytest.raises(ConfigError) as raised:
        load_campaign(write_campaign(tmp_path, f'lateness = "{path.name}"'))
    assert raised.value.faults == [
        f"lateness: {path.name} has no lateness: its ticks ran in virtual time; use a recording of a paced run"
    ]


def test_a_file_that_is_missing_or_no_recording_is_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"none\.mcap: no such file"):
        load_campaign(write_campaign(tmp_path, 'lateness = "none.mcap"'))
    with pytest.raises(RecordingError, match=r"stage\.toml"):
        load_campaign(write_campaign(tmp_path, 'lateness = "stage.toml"'))


def test_lateness_of_some_ticks_is_counted_from_their_first_deadline(tmp_path, monkeypatch):
    """NaN is left out, negative lateness counts as 0, and the limit is one second."""
    columns = {
        "lateness_us": np.array([5.0, np.nan, -1.0, 20.1234, 3.0, 840.0, 90.0]),
        "periods_missed": np.array([0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 3.0]),  # the last one: 590 of 750 µs counted before
    }

    class Recording:
        """Stand-in for a recording at 4 kHz with `columns`."""

        header = {"rate_hz": 4000.0}  # noqa: RUF012

        def read(self, *names: str) -> list[np.ndarray]:
            """Return the named columns."""
            return [columns[name] for name in names]

    monkeypatch.setattr("rtloop.campaigns.recorded_lateness.load", lambda _: Recording())
    assert recorded_lateness(tmp_path / "a.mcap") == (0.0, 5.0, 20.123, 250.0, 503.0, 840.0)
    columns["lateness_us"][0] = 1e6 + 1
    with pytest.raises(ConfigError, match=r"lateness: a\.mcap has a tick that is 1e\+06 µs late; allowed: at most"):
        recorded_lateness(tmp_path / "a.mcap")


def test_experiments_with_late_ticks_run_to_their_end(tmp_path):
    experiments = STEPS + '[[experiment]]\nkind = "scan"\namplitude_um = 5.0\nfrequency_hz = 50.0\nperiods = 3.0\n'
    case = CaseRunner(make_campaign(tmp_path, (*100 * (10.0,), 130.0), experiments=experiments)).run(1)
    assert all(np.isfinite(value) for value in case.figures.values())
