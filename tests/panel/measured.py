"""A rig for measurements from the panel: a model and a specification, and a resonance beside the model's."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.service.test_response import CONFIGURATION, HELD_UM, LOOP

MODEL_HZ = LOOP.hz / 1.05
"""The model's resonance: the rig's lies 5 % above it."""
_OMEGA = 2 * np.pi * MODEL_HZ
_MODEL = f"""
[axis.model]
form = "factors"
gain = {_OMEGA**2!r}
denominator = [[1.0, {2 * LOOP.damping * _OMEGA!r}, {_OMEGA**2!r}]]
"""
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
WANTED_UM = HELD_UM + 4.0 * np.sin(2 * np.pi * np.arange(TICKS) / TICKS)
"""One period of a scan (n,)."""


def configuration(folder: Path, *changes: tuple[str, str]) -> str:
    """Return the text of the rig's configuration and write its specification to `folder`."""
    (folder / "spec.toml").write_text(_SPECIFICATION)
    text = CONFIGURATION.replace("FOLDER", str(folder)).replace("[axis.interlocks]", _MODEL + "[axis.interlocks]")
    for old, new in (('name = "x"\n', 'name = "x"\nspecification = "spec.toml"\n'), *changes):
        text = text.replace(old, new)
    return text
