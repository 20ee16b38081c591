"""A simulated stage whose drive goes from -2 to 10 V, with hysteresis, and its play operators sample by sample."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
from scipy import optimize

from tests.stage_text import resonance, wired

THRESHOLDS_V = (0.0, 0.6, 1.2, 2.4, 3.6, 4.8)
WEIGHTS_UM_PER_V = (2.682529, 0.430546, 0.287031, 0.430546, 0.287031, 0.287031)
LOWEST_V, HIGHEST_V = -2.0, 10.0
OMEGA, ZETA, RATE_HZ = 2 * np.pi * 800.0, 0.3, 10_000.0
_DYNAMICS = resonance(OMEGA, ZETA)
_PLAYS = f"""thresholds_v = {list(THRESHOLDS_V)}
weights_um_per_v = {list(WEIGHTS_UM_PER_V)}
"""
STAGE = f"""
[loop]
rate_hz = {RATE_HZ}
[driver]
kind = "sim"
seed = 4
{wired("adc0", "dac0")}
[driver.plant.hysteresis]
truth = "custom"
{_PLAYS}
[driver.plant.dynamics]
{_DYNAMICS}
[driver.plant.sensor]
um_per_v = 10.0
noise_um = 0.001
resolution_um = 0.0
[[axis]]
name = "x"
[axis.feedforward]
{_PLAYS}
[axis.limits]
drive_min_v = {LOWEST_V}
drive_v = {HIGHEST_V}
command_um = 60.0
[axis.controller]
form = "transfer_function"
numerator = [600.0]
denominator = [1.0, 0.0]
method = "tustin"
[axis.model]
{_DYNAMICS}
"""


class Plays:
    """The stage's play operators, one sample after the other, from rest at 0 V."""

    def __init__(self) -> None:
        self.outputs = [0.0] * len(THRESHOLDS_V)

    def displacement(self, drive_v: float) -> tuple[list[float], float]:
        """Return the outputs of the plays and the displacement in µm at a drive, without moving the stage."""
        outputs = [max(drive_v - r, min(drive_v + r, last)) for r, last in zip(THRESHOLDS_V, self.outputs, strict=True)]
        return outputs, sum(p * output for p, output in zip(WEIGHTS_UM_PER_V, outputs, strict=True))

    def move(self, drive_v: float) -> float:
        """Move to a drive; return the displacement in µm."""
        self.outputs, displacement_um = self.displacement(drive_v)
        return displacement_um

    def drive_to(self, position_um: float) -> float:
        """Move to a position; return the drive in V that this needs, by a search for the root."""
        drive_v = optimize.brentq(lambda drive: self.displacement(drive)[1] - position_um, -50.0, 50.0, xtol=1e-12)
        self.move(drive_v)
        return float(drive_v)


def curve(drives_v: Iterable[float]) -> np.ndarray:
    """Return the displacement in µm for each of the drives in V, from rest."""
    plays = Plays()
    return np.array([plays.move(drive) for drive in drives_v])


def major_loop() -> tuple[float, float]:
    """Return height and width in µm of the loop between both ends of the drive, by interpolation of its branches."""
    ends = (0.0, HIGHEST_V, LOWEST_V, HIGHEST_V)
    legs = [np.linspace(start, end, 4001) for start, end in itertools.pairwise(ends)]
    displacement_um = curve(np.concatenate(legs))
    falling, rising = displacement_um[4001:8002], displacement_um[8002:]
    height_um = np.max(np.abs(falling - np.interp(legs[1], legs[2], rising)))
    return float(height_um), float(np.ptp(falling))
