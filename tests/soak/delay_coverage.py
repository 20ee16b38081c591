"""Coverage of the truth by the ± of identified parameters: many recordings of one rig, each with other noise.

First the actuator is known and has no hysteresis, so that the static gain has a true value; then it is identified too.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtloop.design.chain import identify_stage
from rtloop.design.identification.axis_recording import read_axis_recording
from rtloop.design.identification.dynamics.dynamics_fit import DynamicsFit
from rtloop.design.identification.dynamics.identify_dynamics import identify_dynamics
from rtloop.design.identification.dynamics.prediction_error import Excitation
from tests.recording.real_loop import record
from tests.soak.lagged_rig import DAMPING, HZ, Rig

NORMAL_95 = 1.96
"""Half-width of a 95 % interval, in standard deviations."""
LEAST_COVERED, MOST_COVERED = 0.90, 0.99
KNOWN_UM_PER_V, KNOWN_STEP_V = 2.0, 7.5
"""Gain of an actuator without hysteresis, and a step that a converter of 16 bits represents exactly."""


class Estimate(NamedTuple):
    """Name of a parameter, error of its estimate, and stated standard deviation."""

    parameter: str
    error: float
    std: float


def list_estimates(fit: DynamicsFit, rig: Rig, gain: float | None) -> list[Estimate]:
    """Return the estimates of resonance and lag, and of the static gain where its true value `gain` is given."""
    resonance = min(fit.modes, key=lambda mode: mode.damping)
    estimates = [
        Estimate("frequency", resonance.frequency_hz - HZ, resonance.frequency_std_hz),
        Estimate("damping", resonance.damping - DAMPING, resonance.damping_std),
    ]
    other_modes = [mode for mode in fit.modes if mode is not resonance]
    if other_modes:
        lag = max(other_modes, key=lambda mode: mode.static_share)
        estimates.append(Estimate("lag", lag.frequency_hz - rig.lag_hz, lag.frequency_std_hz))
    return estimates if gain is None else [*estimates, Estimate("gain", fit.static_gain - gain, fit.static_gain_std)]


def identify_with_known_actuator(rig: Rig, seed: int, folder: Path) -> DynamicsFit:
    """Identify the dynamics from the drive of an actuator without hysteresis."""
    text = rig.text("own-stage", seed).replace("value = 10.0", f"value = {KNOWN_STEP_V}")
    text = re.sub(
        r"thresholds_v = \[.*\]\nweights_um_per_v = \[1.3.*\]",
        f"thresholds_v = [0.0]\nweights_um_per_v = [{KNOWN_UM_PER_V}]",
        text,
    )
    run = read_axis_recording(record(folder / f"known-{seed}.mcap", text, 10_000)[0], None)
    return identify_dynamics(Excitation(run.name, run.drive_v, run.position_um, run.period_s))


def identify_with_actuator(rig: Rig, seed: int, folder: Path) -> DynamicsFit:
    """Identify actuator and dynamics from a slow sine and a step up and down, as `design auto` does."""
    sine = record(folder / f"sine-{seed}.mcap", rig.text("own-stage-sine", seed), 25_000)[0]
    steps = record(folder / f"steps-{seed}.mcap", rig.text("own-stage", seed), 10_000)[0]
    return identify_stage(read_axis_recording(sine, None), read_axis_recording(steps, None)).dynamics


def check_coverage(rig: Rig, draws: int) -> bool:
    """Print how often ± covers the truth. Return whether 90 to 99 % of all estimates do, and each delay is right."""
    passed = True
    for name, identify, gain in (
        ("actuator known", identify_with_known_actuator, KNOWN_UM_PER_V),
        ("actuator identified", identify_with_actuator, None),
    ):
        fits: list[DynamicsFit] = []
        for seed in range(1, draws + 1):
            with tempfile.TemporaryDirectory() as folder:
                fits.append(identify(rig, seed, Path(folder)))
        estimates = [estimate for fit in fits for estimate in list_estimates(fit, rig, gain)]
        right_delays = sum(fit.delay_ticks == rig.delay_ticks for fit in fits)
        white_residuals = sum(fit.tests.is_white for fit in fits)
        print(f"{name}: {draws} draws, delay right in {right_delays}, residuals white in {white_residuals}")
        for parameter in dict.fromkeys(estimate.parameter for estimate in estimates):
            of_parameter = [estimate for estimate in estimates if estimate.parameter == parameter]
            errors, stds = (
                np.array([estimate.error for estimate in of_parameter]),
                np.array([estimate.std for estimate in of_parameter]),
            )
            print(
                f"  {parameter:10} mean error {errors.mean():+.3g}, spread {errors.std():.3g}, stated "
                f"{np.median(stds):.3g}, covered {100 * covered_share(of_parameter):.0f} % of {len(of_parameter)}"
            )
        share = covered_share(estimates)
        passed &= LEAST_COVERED <= share <= MOST_COVERED and right_delays == draws
        print(f"  all parameters {100 * share:.1f} %", flush=True)
    return passed


def covered_share(estimates: list[Estimate]) -> float:
    """Return the share of the estimates whose ± at 95 % covers the truth."""
    return float(np.mean([abs(estimate.error) <= NORMAL_95 * estimate.std for estimate in estimates]))
