"""Scans are learned from cycle to cycle; their errors are recomputed from the recordings, which replay."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from rtloop.cli import main
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from tests.service.test_run import PAPER

SLOW = '[axis.controller]\nform = "zpk"\ngain = 60.0\nzeros = []\npoles = [[0.0, 0.0]]\n'
CYCLES = 1


def run(config: Path, folder: Path, *settings: str) -> Result:
    """Run the experiment `scan` with settings of its options, and recordings in a folder."""
    sets = [part for setting in settings for part in ("--set", f"scan.{setting}")]
    return CliRunner().invoke(main, ["experiment", "run", "scan", str(config), *sets, "--json", "--out", str(folder)])


@pytest.fixture(scope="module")
def learned_scan(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Folder and JSON report of a scan that a slow integrator learns."""
    folder = tmp_path_factory.mktemp("scan")
    text = PAPER.read_text()
    begin, end = text.index("[axis.controller]"), text.index("[axis.model]")
    config = folder / "slow.toml"
    config.write_text(
        (text[:begin] + SLOW + text[end:]).replace("paper-spec.toml", str(PAPER.with_name("paper-spec.toml")))
    )
    result = run(
        config, folder, "frequencies_hz=[50.0]", f"cycles={CYCLES}", "amplitude_um=10.0", "resonance_percent=5.0"
    )
    assert result.exit_code == 0, result.stderr
    return folder, json.loads(result.stdout)["experiments"][0]


def test_a_scan_is_learned_from_recording_to_recording(learned_scan):
    folder, section = learned_scan
    (row,) = section["tables"][0]["rows"]
    percent = [float(value) for value in row[1 : CYCLES + 2]]
    assert percent[0] > 10.0
    assert percent[-1] < percent[0] / 5
    assert len(section["recordings"]) == CYCLES + 1
    for cycle, (name, percent_error) in enumerate(zip(section["recordings"], percent, strict=True)):
        recording = load(folder / name)
        position = recording["x_position_um"][-2000:].reshape(-1, 200).mean(axis=0)
        cycle_shares = np.arange(200) / 200
        reference_um = 10.0 * 2 / np.pi * np.arcsin(np.sin(2 * np.pi * cycle_shares))
        assert 100 * np.sqrt(np.mean((reference_um - position) ** 2)) / 20 == pytest.approx(percent_error, abs=1e-3)
        assert np.any(recording["x_feed_um"]) == (cycle > 0)


def test_a_learned_scan_replays(learned_scan):
    folder, section = learned_scan
    assert replay(load(folder / section["recordings"][-1])).identical


def test_a_loop_that_may_be_unstable_learns_nothing(tmp_path):
    """The paper's loop is unstable if its resonance is 2 % higher."""
    result = run(PAPER, tmp_path)
    assert result.exit_code == 1
    assert "the loop is unstable with resonance +2 %; learning needs a loop" in result.stderr
    assert not list(tmp_path.glob("*.mcap"))


def test_a_table_that_cannot_be_written_leaves_the_report_of_the_recorded_runs(learned_scan, tmp_path: Path):
    """The table of the next cycle cannot be written, as a folder has its name."""
    config = learned_scan[0] / "slow.toml"
    (tmp_path / "slow" / "scan-1-50Hz.npy").mkdir(parents=True)
    result = run(config, tmp_path, "frequencies_hz=[50.0]", "cycles=1", "amplitude_um=10.0", "resonance_percent=5.0")
    assert result.exit_code == 1
    assert "scan-1-50Hz.npy: Is a directory" in result.stderr
    (recording,) = tmp_path.rglob("*.mcap")
    (section,) = json.loads(result.stdout)["experiments"]
    assert section["recordings"] == [recording.name]
    assert recording.name in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_cycle_in_which_the_loop_trips_is_the_last(learned_scan, tmp_path: Path):
    """The integrator is slow, and its error trips the loop."""
    config, text = tmp_path / "slow.toml", (learned_scan[0] / "slow.toml").read_text()
    limits = ("tracking_error_um = 10.0", "tracking_error_um = 3.0"), ("tracking_ticks = 500", "tracking_ticks = 50")
    for old, new in limits:
        assert text.count(old) == 1
        text = text.replace(old, new)
    config.write_text(text)
    result = run(config, tmp_path, "frequencies_hz=[50.0]", "cycles=1", "amplitude_um=10.0", "resonance_percent=5.0")
    assert result.exit_code == 1
    assert re.search(r"the loop tripped at tick \d+ \(tracking\)", result.stderr)
    (recording,) = tmp_path.rglob("*.mcap")
    (section,) = json.loads(result.stdout)["experiments"]
    assert section["recordings"] == [recording.name]


def test_a_frequency_that_the_ticks_do_not_divide(tmp_path):
    result = run(PAPER, tmp_path, "frequencies_hz=[30.0]")
    assert result.exit_code == 78
    message = (
        "scan.frequencies_hz: 30 Hz; allowed: frequencies with a period of 4 or more whole ticks, each of 0.0001 s"
    )
    assert message in result.stderr
