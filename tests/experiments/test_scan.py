"""Scans that are learned, what the recordings say, and that they replay."""

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
    sets = [part for one in settings for part in ("--set", f"scan.{one}")]
    return CliRunner().invoke(main, ["experiment", "run", "scan", str(config), *sets, "--json", "--out", str(folder)])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Folder and JSON of a scan that a slow integrator learns."""
    folder = tmp_path_factory.mktemp("scan")
    text = PAPER.read_text()
    begin, end = text.index("[axis.controller]"), text.index("[axis.model]")
    config = folder / "slow.toml"
    config.write_text(
        (text[:begin] + SLOW + text[end:]).replace("paper-spec.toml", str(PAPER.with_name("paper-spec.toml")))
    )
    ran = run(config, folder, "frequencies_hz=[50.0]", f"cycles={CYCLES}", "amplitude_um=10.0", "resonance_percent=5.0")
    assert ran.exit_code == 0, ran.stderr
    return folder, json.loads(ran.stdout)["experiments"][0]


def test_a_scan_is_learned_from_recording_to_recording(made):
    folder, section = made
    (row,) = section["tables"][0]["rows"]
    percent = [float(value) for value in row[1 : CYCLES + 2]]
    assert percent[0] > 10.0
    assert percent[-1] < percent[0] / 5
    assert len(section["recordings"]) == CYCLES + 1
    for cycle, (name, said) in enumerate(zip(section["recordings"], percent, strict=True)):
        recording = load(folder / name)
        position = recording["x_position_um"][-2000:].reshape(-1, 200).mean(axis=0)
        turns = np.arange(200) / 200
        wanted = 10.0 * 2 / np.pi * np.arcsin(np.sin(2 * np.pi * turns))
        assert 100 * np.sqrt(np.mean((wanted - position) ** 2)) / 20 == pytest.approx(said, abs=1e-3)
        assert np.any(recording["x_feed_um"]) == (cycle > 0)


def test_a_learned_scan_replays(made):
    folder, section = made
    assert replay(load(folder / section["recordings"][-1])).identical


def test_a_loop_that_may_be_unstable_learns_nothing(tmp_path):
    """The paper's, at a resonance 2 % higher."""
    ran = run(PAPER, tmp_path)
    assert ran.exit_code == 1
    assert "the loop is unstable with resonance +2 %; learning needs a loop" in ran.stderr
    assert not list(tmp_path.glob("*.mcap"))


def test_a_table_that_cannot_be_written_leaves_the_report_of_the_recorded_runs(made, tmp_path: Path):
    """Of the next cycle: a folder has its name."""
    config = made[0] / "slow.toml"
    (tmp_path / "slow" / "scan-1-50Hz.npy").mkdir(parents=True)
    ran = run(config, tmp_path, "frequencies_hz=[50.0]", "cycles=1", "amplitude_um=10.0", "resonance_percent=5.0")
    assert ran.exit_code == 1
    assert "scan-1-50Hz.npy: Is a directory" in ran.stderr
    (recording,) = tmp_path.rglob("*.mcap")
    (section,) = json.loads(ran.stdout)["experiments"]
    assert section["recordings"] == [recording.name]
    assert recording.name in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_cycle_in_which_the_loop_trips_is_the_last(made, tmp_path: Path):
    """The integrator is slow, and its error trips the loop."""
    config, text = tmp_path / "slow.toml", (made[0] / "slow.toml").read_text()
    limits = ("tracking_error_um = 10.0", "tracking_error_um = 3.0"), ("tracking_ticks = 500", "tracking_ticks = 50")
    for old, new in limits:
        assert text.count(old) == 1
        text = text.replace(old, new)
    config.write_text(text)
    ran = run(config, tmp_path, "frequencies_hz=[50.0]", "cycles=1", "amplitude_um=10.0", "resonance_percent=5.0")
    assert ran.exit_code == 1
    assert re.search(r"the loop tripped at tick \d+ \(tracking\)", ran.stderr)
    (recording,) = tmp_path.rglob("*.mcap")
    (section,) = json.loads(ran.stdout)["experiments"]
    assert section["recordings"] == [recording.name]


def test_a_frequency_that_the_ticks_do_not_divide(tmp_path):
    ran = run(PAPER, tmp_path, "frequencies_hz=[30.0]")
    assert ran.exit_code == 78
    assert "scan.frequencies_hz: 30 Hz; allowed: periods of 4 or more whole ticks of 0.0001 s" in ran.stderr
