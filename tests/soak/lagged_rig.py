"""The stage of deploy/own-stage.toml with a lag behind its resonance, a delay, and more noise."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from tests.recording.real_loop import ROOT

DEPLOY = ROOT / "deploy"
HZ, DAMPING, NOISE_UM = 800.0, 0.02, 0.020


class Rig(NamedTuple):
    """Corner frequency (Hz) of the lag, and samples of delay."""

    lag_hz: float
    delay_ticks: int

    def text(self, name: str, seed: int) -> str:
        """Return the configuration `name` of deploy/ with this rig, NOISE_UM of noise and the noise's seed."""
        rate = 2 * np.pi * self.lag_hz
        omega = 2 * np.pi * HZ
        factors = [[1.0, 2 * DAMPING * omega, omega**2], [1.0, rate]]
        text = (DEPLOY / f"{name}.toml").read_text(encoding="utf-8")
        for key, value in {
            "seed": seed,
            "gain": omega**2 * rate,
            "denominator": factors,
            "noise_um": NOISE_UM,
            **({"latency_ticks": self.delay_ticks} if "latency_ticks" in text else {}),
        }.items():
            text = replace_value(text, key, value)
        return text


RIGS = (
    Rig(2500, 1), Rig(2500, 0), Rig(2500, 2), Rig(2500, 3), Rig(1000, 0), Rig(1000, 2), Rig(1700, 1), Rig(1700, 3),
    Rig(4000, 0), Rig(4000, 2),
)  # fmt: skip


def replace_value(text: str, key: str, value: object) -> str:
    """Return `text` with another value of a key. Raises AssertionError unless `text` has the key once."""
    changed, count = re.subn(rf"(?m)^{key} = .*$", f"{key} = {value!r}", text)
    assert count == 1, (key, count)
    return changed
