"""A third party's driver, installed and found by its entry point, closes the loop, and the run replays."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

import rtloop
from rtloop.drivers.base import Driver, Wiring
from rtloop.drivers.contract import DriverContract
from rtloop.drivers.registry import driver_class
from rtloop.recording.replay.replay import replay
from tests.drivers.installing import install
from tests.drivers.processes import completed
from tests.stage_text import one_axis

pytestmark = pytest.mark.system

CONFIG = """
[loop]
rate_hz = {rate_hz}
[driver]
kind = "bench_card"
seed = 3
[driver.channels.x]
input = "in"
output = "out"
um_per_v = 10.0
{axis}
[axis.reference]
kind = "steps"
levels = [10.0, -10.0]
dwell_s = 0.5
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder into which the package is installed."""
    return install(tmp_path_factory.mktemp("installed"))


def run_rtloop(installed: Path, *arguments: str) -> str:
    """Run a command of rtloop that finds the package, and return its stdout."""
    result = completed(sys.executable, "-m", "rtloop", *arguments, folder=installed)
    assert result.returncode == 0, result.stderr
    return result.stdout


class TestContract(DriverContract):
    @pytest.fixture(autouse=True)
    def _installed(self, installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.syspath_prepend(installed)

    def driver(self) -> Driver:
        kind = driver_class("bench_card")
        return kind(kind.options_model(), {"x": Wiring("in", "out")}, 1000.0)


def test_it_is_listed(installed):
    assert "bench_card:BenchCard" in run_rtloop(installed, "drivers")


@pytest.mark.parametrize("rate_hz", [2_000, 10_000])
def test_it_closes_the_loop_and_replays(installed, tmp_path, rate_hz):
    config = tmp_path / "bench.toml"
    config.write_text(CONFIG.format(rate_hz=rate_hz, axis=one_axis(20.0)))
    summary = json.loads(run_rtloop(installed, "run", str(config), "--duration", "2", "--out", str(tmp_path), "--json"))
    assert summary["ticks_logged"] == summary["ticks_expected"] == 2 * rate_hz
    assert summary["ticks_lost"] == 0
    recording = rtloop.load(summary["recording"])
    ends = recording["x_true_position_um"].reshape(4, -1)[:, -50:].mean(axis=1)
    assert np.allclose(ends, [10.0, -10.0, 10.0, -10.0], atol=0.1)
    verdict = replay(recording)
    assert (verdict.identical, verdict.ticks) == (True, 2 * rate_hz)
