"""Steps and rest as they will be, simulated: the law itself, with hysteresis, limits, rounding and noise.

Positions are true ones, without the sensor's noise, and those between ticks: D(s) is driven by what the actuator did,
which stands still for a period.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rtloop.analysis.held_plant import POINTS, held_plant
from rtloop.configuration.axis import AxisOptions
from rtloop.design.verification.bench import Bench
from rtloop.hil.modal import Real
from rtloop.hil.options import RigOptions
from rtloop.hil.rig import zeros_poles_gain
from rtloop.hysteresis.plays import loading_curve
from rtloop.linear.transfer import Transfer
from rtloop.recording.views.steps import step_metrics
from rtloop.signals import Flag, trip_causes

SHORTEST_DWELL_S, LONGEST_DWELL_S, TIME_CONSTANTS = 0.1, 1.0, 12.0
"""Of a level: so many of the slowest mode."""
REST_S, SETTLES_S = 1.0, 0.5
"""How long the rest is looked at, and what passes before."""
LIMITED = {Flag.COMMAND_LIMITED: "command", Flag.DRIVE_LIMITED: "drive", Flag.SLEW_LIMITED: "slew"}


class SimulatedStep(NamedTuple):
    """The worst of steps of one height, up and down, to both sides; what limited, and what tripped it."""

    height_um: float
    settling_ms: float
    overshoot_percent: float
    static_error_percent: float
    peak_drive_v: float
    limited: tuple[str, ...]
    trips: tuple[str, ...]


@dataclass(frozen=True)
class Simulated:
    """What came of it: steps, heights that the range does not allow, rms at rest; `truth` is what was simulated."""

    truth: str
    steps: tuple[SimulatedStep, ...]
    left_out_um: tuple[float, ...]
    noise_x_nm: float
    noise_v_nm: float


def simulate(bench: Bench, axis: AxisOptions, slowest_s: float, heights_um: Sequence[float]) -> Simulated:
    """Steps of an axis whose linear loop has `slowest_s` as its slowest time constant."""
    dwell_s = min(max(TIME_CONSTANTS * slowest_s, SHORTEST_DWELL_S), LONGEST_DWELL_S)
    reach_um, downwards = _reach(axis)
    possible = [height for height in heights_um if height <= reach_um]
    found = []
    for height in possible:
        levels = (0.0, height, 0.0, -height, 0.0) if downwards else (0.0, height, 0.0, height, 0.0)
        found.append(_judged(bench.rig, bench.run(axis.name, levels, dwell_s), axis.name, height, bench.rate_hz))
    rest = bench.run(axis.name, (0.0,), SETTLES_S + REST_S)
    last = slice(round(SETTLES_S * bench.rate_hz), None)
    noise = [1e3 * float(rest[f"{axis.name}_{name}"][last].std()) for name in ("true_position_um", "command_um")]
    truth = "the configured rig" if bench.is_configured else "a rig after the axis's models"
    return Simulated(truth, tuple(found), tuple(sorted(set(heights_um) - set(possible))), *noise)


def _reach(axis: AxisOptions) -> tuple[float, bool]:
    """How far a command may go at rest, and whether to both sides."""
    limits, actuator = axis.limits, axis.feedforward.actuator()
    to_both = limits.lowest_v < 0
    drive_v = min(limits.drive_v, -limits.lowest_v) if to_both else limits.drive_v
    return min(limits.command_um, abs(float(loading_curve(actuator, drive_v)))), to_both


def _judged(rig: RigOptions, run: Mapping[str, Real], axis: str, height_um: float, rate_hz: float) -> SimulatedStep:
    flags = run["flags"].astype(np.int64)
    ever = int(np.bitwise_or.reduce(flags))
    metrics = step_metrics(
        np.repeat(run[f"{axis}_reference_um"], POINTS), between_ticks(rig, run, axis, rate_hz), POINTS * rate_hz
    )
    assert metrics is not None
    return SimulatedStep(
        height_um,
        metrics.settling_time_ms_worst,
        metrics.overshoot_percent_worst,
        metrics.static_error_percent_worst,
        float(np.abs(run[f"{axis}_drive_v"]).max()),
        tuple(name for flag, name in LIMITED.items() if ever & flag),
        tuple(trip_causes(ever)),
    )


def between_ticks(rig: RigOptions, run: Mapping[str, Real], axis: str, rate_hz: float) -> Real:
    """True positions at `POINTS` of each period, (POINTS·ticks,).

    What hysteresis, creep and coupled axes do is held and goes through D(s); what else moves the position, such as a
    disturbance, or memory from before the run, is taken to be straight between ticks.
    """
    dynamics = rig.plants.get(axis, rig.plant).dynamics
    held = held_plant(Transfer(*zeros_poles_gain(dynamics)), 1 / rate_hz)
    moved = run[f"{axis}_hysteresis_um"].copy()
    for other, share in rig.coupling.get(axis, {}).items():
        moved += share * run[f"{other}_hysteresis_um"]
    inputs = np.append(moved[1:], moved[-1])  # a record has what the period before it did
    states = np.zeros((inputs.size, held.system.b.size))
    for k, value in enumerate(inputs[:-1].tolist()):
        states[k + 1] = held.system.a @ states[k] + held.system.b * value
    positions = held.between.rows @ states.T + np.outer(held.between.direct, inputs)
    true_um, ticks = run[f"{axis}_true_position_um"], np.arange(inputs.size)
    times = (ticks[:, None] + np.arange(POINTS) / POINTS).ravel()
    return positions.T.ravel() + np.interp(times, ticks, true_um - positions[0])
