"""A third-party driver in plain Python, found by its entry point, closes the loop at 10 kHz; its recording replays."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import rtloop
from rtloop.recording.replay.replay import replay
from tests.stage_text import one_axis

pytestmark = pytest.mark.system

ROOT = Path(__file__).resolve().parents[2]

DRIVER = '''
"""A first-order plant of 4.3 µm/V behind 10 µm/V, in plain Python."""

from rtloop.drivers.base import Channel, Facts
from rtloop.drivers.python import PythonDriver


class LagDriver(PythonDriver):
    kind = "lag"

    @property
    def facts(self):
        return Facts((Channel("in"),), (Channel("out"),), observed=("x_true_position_um",), real=False)

    def start(self):
        self.position_um, self.drive_v, self.open_ = 0.0, 0.0, True

    def read(self):
        self.position_um += 0.1 * (4.3 * self.drive_v - self.position_um)
        return [self.position_um / 10.0]

    def observe(self):
        return [self.position_um]

    def write(self, volts):
        self.drive_v = volts[0]

    def stop(self):
        self.open_ = False
'''

CONFIG = """
[loop]
rate_hz = 10000
[driver]
kind = "lag"
[driver.channels.x]
input = "in"
output = "out"
um_per_v = 10.0
{axis}
[axis.model]
form = "zpk"
gain = 1000.0
poles = [[-1000.0, 0.0]]
[axis.reference]
kind = "steps"
levels = [10.0, -10.0]
dwell_s = 0.1
"""


def install(folder: Path, driver: str) -> tuple[Path, dict[str, str]]:
    """Install the driver as a package in `folder`; return a configuration and an environment that use the package."""
    (folder / "lag_driver.py").write_text(driver)
    metadata = folder / "lag_driver-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: lag-driver\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[rtloop.drivers]\nlag = lag_driver:LagDriver\n")
    config = folder / "lag.toml"
    config.write_text(CONFIG.format(axis=one_axis(400.0)))
    return config, os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{folder}"}


def test_a_plain_python_driver_closes_the_loop_at_10_khz(tmp_path: Path) -> None:
    config, environment = install(tmp_path, DRIVER)
    command = [sys.executable, "-m", "rtloop", "run", str(config), "--duration", "2", "--out", str(tmp_path), "--json"]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert result.returncode == 0, result.stderr
    summary = json.loads(result.stdout)
    assert summary["ticks_logged"] == summary["ticks_expected"] == 20_000
    assert summary["ticks_lost"] == 0
    recording = rtloop.load(summary["recording"])
    settled = recording["x_position_um"][1999::1000]  # The first step is entered by a glide.
    assert np.allclose(settled, np.resize([-10.0, 10.0], settled.size), atol=0.01)
    verdict = replay(recording)
    assert (verdict.identical, verdict.ticks) == (True, 20_000)
