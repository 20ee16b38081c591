"""Configuration for measurements from the panel: a model, a specification, and a rig with another resonance."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.service.test_response import CONFIGURATION, LOOP, SETPOINT_UM
from tests.stage_text import resonance

MODEL_HZ = LOOP.hz / 1.05
"""Resonance of the model; the resonance of the rig lies 5 % above it."""
_OMEGA = 2 * np.pi * MODEL_HZ
_MODEL = f"""
[axis.model]
{resonance(_OMEGA, LOOP.damping)}"""
_SPECIFICATION = """
[specification]
overshoot_percent = 1.0
[specification.command]
reference_um = 10.0
command_um = 43.0
[shape]
taps = 20
settling_ms = 1.5
points_per_tick = 2
"""
TICKS = 100
SCAN_UM = SETPOINT_UM + 4.0 * np.sin(2 * np.pi * np.arange(TICKS) / TICKS)
"""One period of a scan: the reference of each tick, (TICKS,)."""


def make_configuration(folder: Path, *changes: tuple[str, str]) -> str:
    """Write the specification to `folder`; return the text of the configuration, with the `changes` (old, new)."""
    (folder / "spec.toml").write_text(_SPECIFICATION)
    text = CONFIGURATION.replace("FOLDER", str(folder)).replace("[axis.interlocks]", _MODEL + "[axis.interlocks]")
    for old, new in (('name = "x"\n', 'name = "x"\nspecification = "spec.toml"\n'), *changes):
        text = text.replace(old, new)
    return text
