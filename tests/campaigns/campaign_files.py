"""Campaigns for tests: short experiments with the paper's loop on varied rigs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAPER = ROOT / "deploy/paper.toml"
UNCERTAIN = """
"driver.plant.dynamics.resonance_shift" = { uniform = [-0.1, 0.1] }
"driver.plant.dynamics.damping_factor" = { log_uniform = [0.5, 2.0] }
"driver.plant.dynamics.gain_factor" = { normal = [1.0, 0.02], limits = [0.95, 1.05] }
"""
STEPS = """
[[experiment]]
kind = "steps"
levels_um = [10.0]
dwell_s = 0.03
"""


def write_campaign(
    folder: Path, keys: str = "", uncertain: str = UNCERTAIN, experiments: str = STEPS, limits: str = "",
    configuration: Path = PAPER,
) -> Path:  # fmt: skip
    """Write a campaign of a configuration and return its path."""
    path = folder / "stage.toml"
    path.write_text(
        f'configuration = "{configuration}"\nseed = 5\nkeep_worst = 0\n{keys}\n[uncertain]\n{uncertain}\n'
        f"{experiments}\n"
        f'[limits]\n"steps.static_error_percent" = 5.0\n"steps.settling_ms" = 20.0\n'
        f'"steps.overshoot_percent" = 20.0\n{limits}\n'
    )
    return path


def rtloop(*arguments: object, folder: Path, environment: dict[str, str] | None = None) -> subprocess.Popen[str]:
    """Start the command line in a folder, with a new process group."""
    return subprocess.Popen(
        [sys.executable, "-m", "rtloop", *map(str, arguments)],
        cwd=folder, env={**os.environ, **(environment or {})}, text=True, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def result_files(folder: Path) -> dict[str, bytes]:
    """Return the bytes of each file of results, and of the manifest, by name."""
    paths = [*(folder / "results").iterdir(), folder / "campaign.json"]
    return {path.name: path.read_bytes() for path in paths}
