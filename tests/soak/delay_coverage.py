"""How often ± of an identification covers the truth, by parameter: many recordings of one rig, each with its own noise.

Once the actuator is known and has no hysteresis, so that the static gain has a truth; once it is identified as well.
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
LEAST_COVERED, MOST_COVERED = 0.90, 0.99
KNOWN_UM_PER_V, KNOWN_STEP_V = 2.0, 7.5
"""An actuator without hysteresis, and a step that the converter of 16 bits has exactly."""


class Estimate(NamedTuple):
    """A parameter, its error and its stated standard deviation."""

    parameter: str
    error: float
    std: float


def estimates(fit: DynamicsFit, rig: Rig, gain: float | None) -> list[Estimate]:
    """Errors beside standard deviations; of the static gain where its truth is known."""
    light = min(fit.modes, key=lambda mode: mode.damping)
    found = [
        Estimate("frequency", light.frequency_hz - HZ, light.frequency_std_hz),
        Estimate("damping", light.damping - DAMPING, light.damping_std),
    ]
    others = [mode for mode in fit.modes if mode is not light]
    if others:
        lag = max(others, key=lambda mode: mode.static_share)
        found.append(Estimate("lag", lag.frequency_hz - rig.lag_hz, lag.frequency_std_hz))
    return found if gain is None else [*found, Estimate("gain", fit.static_gain - gain, fit.static_gain_std)]


def with_known_actuator(rig: Rig, seed: int, folder: Path) -> DynamicsFit:
    """Identify from the drive of an actuator without hysteresis."""
    text = rig.text("own-stage", seed).replace("value = 10.0", f"value = {KNOWN_STEP_V}")
    text = re.sub(
        r"thresholds_v = \[.*\]\nweights_um_per_v = \[1.3.*\]",
        f"thresholds_v = [0.0]\nweights_um_per_v = [{KNOWN_UM_PER_V}]",
        text,
    )
    run = read_axis_recording(record(folder / f"known-{seed}.mcap", text, 10_000)[0], None)
    return identify_dynamics(Excitation(run.name, run.drive_v, run.position_um, run.period_s))


def with_identified_actuator(rig: Rig, seed: int, folder: Path) -> DynamicsFit:
    """Identify both from a slow sine and a step up and down, as `design auto` does."""
    sine = record(folder / f"sine-{seed}.mcap", rig.text("own-stage-sine", seed), 25_000)[0]
    steps = record(folder / f"steps-{seed}.mcap", rig.text("own-stage", seed), 10_000)[0]
    return identify_stage(read_axis_recording(sine, None), read_axis_recording(steps, None)).dynamics


def coverage(rig: Rig, draws: int) -> bool:
    """Print how often ± covers the truth; whether it does in 90 to 99 of 100 of all, and the delay is right."""
    good = True
    for name, identify, gain in (
        ("actuator known", with_known_actuator, KNOWN_UM_PER_V),
        ("actuator identified", with_identified_actuator, None),
    ):
        fits: list[DynamicsFit] = []
        for seed in range(1, draws + 1):
            with tempfile.TemporaryDirectory() as folder:
                fits.append(identify(rig, seed, Path(folder)))
        rows = [row for fit in fits for row in estimates(fit, rig, gain)]
        delays = sum(fit.delay_ticks == rig.delay_ticks for fit in fits)
        white = sum(fit.tests.is_white for fit in fits)
        print(f"{name}: {draws} draws, delay right in {delays}, residuals white in {white}")
        for parameter in dict.fromkeys(row.parameter for row in rows):
            of_it = [row for row in rows if row.parameter == parameter]
            errors, stds = np.array([row.error for row in of_it]), np.array([row.std for row in of_it])
            print(
                f"  {parameter:10} mean error {errors.mean():+.3g}, spread {errors.std():.3g}, stated "
                f"{np.median(stds):.3g}, covered {100 * covered(of_it):.0f} % of {len(of_it)}"
            )
        share = covered(rows)
        good &= LEAST_COVERED <= share <= MOST_COVERED and delays == draws
        print(f"  together {100 * share:.1f} %", flush=True)
    return good


def covered(rows: list[Estimate]) -> float:
    """The part of all estimates whose ± at 95 % covers the truth."""
    return float(np.mean([abs(row.error) <= NORMAL_95 * row.std for row in rows]))
