"""`rtloop experiment` with real recordings: figures against eq (5) of the paper, and reports of recordings alone."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from click.testing import CliRunner, Result

from rtloop.cli import main
from rtloop.experiments.recorded_run import RecordedRun
from rtloop.experiments.report import load_runs, make_report
from rtloop.recording.errors import RecordingError
from rtloop.recording.load import load
from tests.service.test_run import ENVIRONMENT, PAPER
from tests.soak.aborts import TIMEOUT_S, abort, check

BOARD = PAPER.with_name("board.toml")
QUICK = (
    "--set", "robustness.shifts_percent=[0.0, 5.0]", "--set", "robustness.duration_s=0.3",
)  # fmt: skip


def run_command(*arguments: str | Path) -> Result:
    """Run `rtloop experiment` in this process."""
    return CliRunner().invoke(main, ["experiment", *map(str, arguments)])


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Folder and JSON report of three quick experiments, one of which has a run that trips."""
    folder = tmp_path_factory.mktemp("experiments")
    names = ("step-response", "compensation", "robustness")
    base_command = [sys.executable, "-m", "rtloop", "experiment", "run", *names, str(PAPER), *QUICK, "--json", "--out"]
    process = subprocess.run(
        [*base_command, str(folder)], env=ENVIRONMENT, capture_output=True, text=True, timeout=TIMEOUT_S
    )
    assert process.returncode == 0, process.stderr
    assert "Traceback" not in process.stderr
    return folder, json.loads(process.stdout)


def section_rows(content: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the rows of an experiment's section of a report, by quantity."""
    section = next(section for section in content["experiments"] if section["name"] == name)
    return {row["quantity"]: row for row in section["rows"]}


def test_the_step_is_that_of_eq_5(campaign: tuple[Path, dict[str, Any]]) -> None:
    rows = section_rows(campaign[1], "step-response")
    assert rows["overshoot"]["run"] == pytest.approx(14.474, abs=0.3)
    assert rows["frequency of the ringing"]["run"] == pytest.approx(595.50, abs=0.2)
    assert rows["damping ratio of the ringing"]["run"] == pytest.approx(0.00735, abs=1e-4)
    assert rows["overshoot"]["claimed"] == "9.5 %"
    assert rows["overshoot"]["as_claimed"] is False
    assert rows["overshoot"]["as_the_model"] is True
    assert "not as claimed" in rows["frequency of the ringing"]["verdict"]


def test_compensation_leaves_the_hysteresis_of_the_rig(campaign: tuple[Path, dict[str, Any]]) -> None:
    rows = section_rows(campaign[1], "compensation")
    delay_s = 925 / 4.59e5 - 1 / 1430 + 0.5e-4  # D's slowest poles and zero, and half a tick of hold
    lag_um = 2 * 2 * np.pi * 0.1 * 40.0 * delay_s  # of both branches, where the sine is fastest
    assert rows["h/H after compensation"]["run"] == pytest.approx(3.75 + 100 * lag_um / 80, abs=0.03)


def test_a_shifted_resonance_trips_and_is_a_result(campaign: tuple[Path, dict[str, Any]]) -> None:
    section = next(entry for entry in campaign[1]["experiments"] if entry["name"] == "robustness")
    assert section["problem"] is None
    assert [row[2] for row in section["tables"][0]["rows"]] == ["settles", "trips (oscillation)"]


def test_the_report_of_the_recordings_alone_is_that_of_the_run(
    campaign: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, content = campaign
    result = run_command("report", folder, "--out", tmp_path, "--json")
    assert result.exit_code == 0, result.output
    repeated = json.loads(result.stdout)
    for key in ("files", "interrupted", "skipped"):
        content.pop(key, None)
        repeated.pop(key, None)
    assert repeated == content
    assert json.loads((tmp_path / "report.json").read_text()) == json.loads((folder / "report.json").read_text())
    page = (tmp_path / "report.html").read_text()
    assert "<script" not in page
    assert page.count("data:image/png") == 2 * len(content["experiments"])
    for section in content["experiments"]:
        assert all(name in page for name in section["recordings"])


def test_a_missing_recording_changes_the_report(campaign: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """A report of fewer recordings differs, so that the equality of reports above can fail."""
    folder, content = campaign
    for path in folder.glob("*robustness*.mcap"):
        shutil.copy(path, tmp_path)
    next(iter(sorted(tmp_path.glob("*.mcap")))).unlink()
    (section,) = make_report(load_runs(sorted(tmp_path.glob("*.mcap")))).content["experiments"]
    assert section["problem"] == "only 1 of 2 recordings of this experiment are given; not analysed. Give all of them"
    assert section not in content["experiments"]


def test_impossible_experiments_name_the_reason(tmp_path: Path) -> None:
    empty = run_command("report", tmp_path)
    assert (empty.exit_code, "no recording (*.mcap) found" in empty.output) == (66, True)
    unknown = run_command("run", "fig3", PAPER)
    assert (unknown.exit_code, "'fig3' is not an experiment" in unknown.output) == (78, True)
    fixed = run_command("run", "disturbance", BOARD, "--out", tmp_path)
    assert fixed.exit_code == 1
    assert "driver.kind: 'shm'; allowed: 'sim', because this experiment changes" in fixed.output
    listed = run_command("list")
    assert listed.exit_code == 0
    assert "harmonic.amplitude_um=2.0" in listed.output


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("from_hz=6000.0", "response: from_hz = 6000 and to_hz = 4500; allowed: 0 < from_hz < to_hz ≤ "),
        (
            "to_hz=3.0",
            "response: the band from 2 to 3 Hz contains 1 odd multiples of 1 Hz (1/period_s); allowed: at least 3",
        ),
        ("period_s=1e-5", "response: the band from 2 to 4500 Hz contains 0 odd multiples of 10000 Hz"),
    ],
)
def test_an_impossible_multisine_is_refused_before_the_run(setting: str, message: str, tmp_path: Path) -> None:
    refused = run_command("run", "response", PAPER, "--set", f"response.{setting}", "--out", tmp_path)
    assert (refused.exit_code, type(refused.exception)) == (78, SystemExit)
    assert message in refused.output
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_campaign_parks_and_reports(tmp_path: Path) -> None:
    after_s = float(np.random.default_rng(1).uniform(0.0, 4.0))
    check(abort(tmp_path, after_s, "paper", str(PAPER)), tmp_path)


def test_a_compared_configuration_gives_the_same_figures_alone(tmp_path: Path) -> None:
    """In virtual time, a run has the same bits alone and beside another run, and in the report of its recordings."""
    robust = PAPER.with_name("robust.toml")
    short = ("--set", "steps.levels_um=[10.0, 0.0]", "--set", "steps.dwell_s=0.1", "--json", "--out")
    both, alone = (
        run_command("run", "steps", *configurations, *short, tmp_path / name)
        for name, configurations in (("both", (PAPER, "--beside", robust)), ("alone", (robust,)))
    )
    assert (both.exit_code, alone.exit_code) == (0, 0), both.output + alone.output
    content, alone_rows = json.loads(both.stdout), section_rows(json.loads(alone.stdout), "steps")
    rows = section_rows(content, "steps")
    assert content["beside"] == "robust"
    assert {name: row["beside"] for name, row in rows.items()} == {name: row["run"] for name, row in alone_rows.items()}
    assert all(row["run"] != row["beside"] for row in rows.values())
    assert all(row["beside"] is None for row in alone_rows.values())
    repeated = run_command("report", tmp_path / "both", "--json")
    assert section_rows(json.loads(repeated.stdout), "steps") == rows
    assert "<th>robust gave</th>" in (tmp_path / "both" / "report.html").read_text(encoding="utf-8")


def test_a_compared_configuration_must_have_the_axis() -> None:
    two = PAPER.with_name("two-axis.toml")
    refused = run_command("run", "steps", two, "--axis", "y", "--beside", PAPER)
    assert refused.exit_code != 0
    assert "--axis y: there is no such axis; allowed: x" in refused.output


def test_a_description_without_a_key_is_named(campaign: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    folder, _ = campaign
    text = load(next(iter(sorted(folder.glob("*.mcap"))))).configuration
    for damaged in (text.replace('"segments"', '"parts"', 1), text.replace('"asked"', '"asked": 5, "old"', 1)):
        with pytest.raises(RecordingError, match="the recorded description of the experiment is damaged"):
            RecordedRun(cast(Any, SimpleNamespace(configuration=damaged, paths=[tmp_path / "run.mcap"])))
