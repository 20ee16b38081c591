"""Simulated steps and rest: the law itself, with hysteresis, limits, rounding and noise.

Positions are the true ones, without sensor noise, also between ticks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import Any, NamedTuple

import numpy as np

from rtloop.analysis.held_plant import POINTS
from rtloop.configuration.axis import AxisOptions
from rtloop.design.synthesis.specification import QUANTITIES, DesignOptions
from rtloop.design.verification.bench import Bench
from rtloop.design.verification.judgement import Limit, required_limits
from rtloop.foundation.arrays import Real
from rtloop.hysteresis.reach import PositionRange, can_hold, reachable_range
from rtloop.recording.views.steps import measure_steps
from rtloop.signals import Flag, trip_causes

SHORTEST_DWELL_S, LONGEST_DWELL_S, TIME_CONSTANTS = 0.1, 1.0, 12.0
"""Dwell at a level: TIME_CONSTANTS times the slowest time constant, within these limits."""
REST_S, SETTLING_S = 2.0, 0.5
"""Duration of the evaluation at rest, and of the settling before it."""
REST_PLACES = (0.03, 0.12, 0.24, 0.48)
"""Levels for the evaluation at rest, as fractions of the range."""
CYCLES, DRAWS, MORE_DRAWS, STEP_QUANTILE = 12, 2, 8, 0.95
"""Repetitions of four steps in a run; number of runs, each with its own noise; number of runs in all if noise
determines the figures; quantile of the steps that is reported.
"""
LARGEST_SPREAD, SPREAD_PERCENT = 0.1, 0.5
"""Spread beyond which noise determines a figure: fraction of a settling time, and percentage points."""
JUDGED_QUANTITIES = ("overshoot_percent", "settling_ms", "static_error_percent")
"""Specified figures of a step, in the order of `measure_steps`."""
LIMIT_FLAGS = {Flag.COMMAND_LIMITED: "command", Flag.DRIVE_LIMITED: "drive", Flag.SLEW_LIMITED: "slew"}


class SimulatedStep(NamedTuple):
    """Figures of the steps of one height, up and down: the STEP_QUANTILE quantile, the median (`typical`, in the
    order of JUDGED_QUANTITIES), active limits, trips, and the lowest and highest level (`levels_um`).

    A quantile, because the worst of a few steps changes from run to run: noise decides when a loop leaves its dead
    band.
    """

    height_um: float
    overshoot_percent: float
    settling_ms: float
    static_error_percent: float
    typical: tuple[float, ...]
    peak_drive_v: float
    limited: tuple[str, ...]
    trips: tuple[str, ...]
    levels_um: tuple[float, float] = (0.0, 0.0)

    def is_repeatable(self, name: str) -> bool:
        """Whether the quantile of figure `name` exceeds the median by at most SPREAD_PERCENT points, or LARGEST_SPREAD
        of itself for the settling time: noise does not decide it. An infinite quantile needs an infinite median.
        """
        quantile, median = getattr(self, name), self.typical[JUDGED_QUANTITIES.index(name)]
        if math.isinf(quantile):
            return math.isinf(median)
        return quantile - median <= (SPREAD_PERCENT if name.endswith("percent") else LARGEST_SPREAD * quantile)


@dataclass(frozen=True)
class SimulationResult:
    """Simulated steps, heights outside the range (`omitted_heights_um`), and rms noise of position x and command v at
    rest.

    `truth` names the simulated system, `command_range` has the static commands that are possible. `required` has the
    limits, which count only if `is_judged`.
    """

    truth: str
    steps: tuple[SimulatedStep, ...]
    omitted_heights_um: tuple[float, ...]
    command_range: PositionRange
    noise_x_nm: float
    noise_v_nm: float
    required: Mapping[str, Limit]
    is_judged: bool

    def is_met(self, step: SimulatedStep, name: str) -> bool | None:
        """Whether a step meets the limit on figure `name`, judged or not; None without limit."""
        return self.required[name].accepts(getattr(step, name)) if name in self.required else None

    @property
    def violations(self) -> list[str]:
        """Requirements that count and are not met: `missed`, or [] without `is_judged`."""
        return self.missed if self.is_judged else []

    @property
    def missed(self) -> list[str]:
        """Requirements that simulated steps do not meet, a text for each height; whatever `is_judged` says."""
        return [
            f"{QUANTITIES[name][0]} of {step.height_um:g} µm steps"
            for step in self.steps
            for name in JUDGED_QUANTITIES
            if self.is_met(step, name) is False
        ] + [f"steps of {step.height_um:g} µm, which trip" for step in self.steps if step.trips]

    def as_dict(self) -> dict[str, Any]:
        """Return the result for JSON: `truth`, `steps`, `left_out_um`, `range_um`, `noise_x_nm`, `noise_v_nm`,
        `judged`.
        """
        steps = [
            {
                **step._asdict(),
                "met": {name: self.is_met(step, name) for name in JUDGED_QUANTITIES if name in self.required},
            }
            for step in self.steps
        ]
        return {
            "truth": self.truth,
            "steps": steps,
            "left_out_um": list(self.omitted_heights_um),
            "range_um": list(self.command_range),
            "noise_x_nm": self.noise_x_nm,
            "noise_v_nm": self.noise_v_nm,
            "judged": self.is_judged,
        }


def simulate(bench: Bench, axis: AxisOptions, slowest_s: float, design: DesignOptions) -> SimulationResult:
    """Simulate steps and rest of an axis whose linear loop has the slowest 1/|Re s| `slowest_s`.

    Each height is simulated where `_levels` places it; heights that fit nowhere are omitted. A height whose figures
    noise decides is run more often. Raises ValueError for a run whose recorded reference has no step, and for a
    hysteresis model without inverse.
    """
    heights_um, is_judged = design.step_heights_um, design.judges_simulated_steps
    dwell_s = min(max(TIME_CONSTANTS * slowest_s, SHORTEST_DWELL_S), LONGEST_DWELL_S)
    command_range = _command_range(axis)
    levels_by_height = {height: _levels(axis, command_range, height) for height in sorted(set(heights_um))}
    simulated_steps = []
    for height, levels in levels_by_height.items():
        if levels is None:
            continue
        steps = [_run_steps(bench, axis.name, levels, dwell_s, draw) for draw in range(DRAWS)]
        step = _summarise_steps(height, levels, steps)
        if not all(step.is_repeatable(name) for name in JUDGED_QUANTITIES):
            steps += [_run_steps(bench, axis.name, levels, dwell_s, draw) for draw in range(DRAWS, MORE_DRAWS)]
            step = _summarise_steps(height, levels, steps)
        simulated_steps.append(step)
    truth = "the configured rig" if bench.is_configured else "a rig after the axis's models"
    omitted = tuple(height for height, levels in levels_by_height.items() if levels is None)
    noise_x_nm, noise_v_nm = _noise_at_rest_nm(bench, axis.name, max(command_range, key=abs))
    required = required_limits(design.specification)
    return SimulationResult(
        truth, tuple(simulated_steps), omitted, command_range, noise_x_nm, noise_v_nm, required, is_judged
    )


def _noise_at_rest_nm(bench: Bench, axis: str, reach_um: float) -> list[float]:
    """Return the rms noise of position and command at rest in nm, averaged over REST_PLACES of the longer side of the
    range, which ends at `reach_um`: in a dead band a loop may hunt.
    """
    squares = []
    for place in REST_PLACES:
        record = bench.run(axis, (place * reach_um,), SETTLING_S + REST_S)
        settled = slice(round(SETTLING_S * bench.rate_hz), None)
        squares.append([record[f"{axis}_{name}"][settled].var() for name in ("true_position_um", "command_um")])
    return [float(1e3 * np.sqrt(mean)) for mean in np.mean(squares, axis=0)]


def _command_range(axis: AxisOptions) -> PositionRange:
    """Return the static commands in µm that limits and drive allow, in any order. Raises ValueError without inverse."""
    limits = axis.limits
    return reachable_range(axis.feedforward.actuator(), limits.lowest_v, limits.drive_v, limits.command_um)


def _levels(axis: AxisOptions, command_range: PositionRange, height_um: float) -> tuple[float, ...] | None:
    """Return the levels in µm of one cycle of steps of a height; None for a height that the range has no room for.

    To both sides of 0 where the drive allows it. A range with unequal sides also has room for steps between 0 and a
    level of its longer side, and for larger ones in its middle. Raises ValueError for a hysteresis model without
    inverse.
    """
    limits, actuator, (low_um, high_um) = axis.limits, axis.feedforward.actuator(), command_range
    if limits.lowest_v == 0.0:  # steps from 0 are the usual ones, although the memory leaves a remanence there
        return 2 * (height_um, 0.0) if height_um <= high_um else None
    middle_um = (low_um + high_um) / 2
    candidates = [
        (height_um, 0.0, -height_um, 0.0),
        2 * (math.copysign(height_um, middle_um), 0.0),
        2 * (middle_um + height_um / 2, middle_um - height_um / 2),
    ]
    for levels in candidates if low_um != -high_um else candidates[:1]:
        if max(map(abs, levels)) <= limits.command_um and can_hold(actuator, levels, limits.lowest_v, limits.drive_v):
            return levels
    return None


class _SteppedRecord(NamedTuple):
    """Overshoot (%), settling time (ms) and static error (%) of each step, (steps, 3), largest |drive| in V, and the
    flags of all ticks combined.
    """

    steps: Real
    peak_drive_v: float
    flags: int


def _run_steps(bench: Bench, axis: str, levels_um: tuple[float, ...], dwell_s: float, draw: int) -> _SteppedRecord:
    """Run CYCLES of steps between levels, from the last one; return the figures of each step.

    `draw` is added to the seed of the noise. Raises ValueError if the recorded reference has no step.
    """
    record = bench.run(axis, (levels_um[-1], *CYCLES * levels_um), dwell_s, draw)
    reference = np.repeat(record[f"{axis}_reference_um"], POINTS)
    steps = measure_steps(reference, bench.true_positions(record, axis).ravel(), POINTS * bench.rate_hz)
    if steps is None:
        raise ValueError(f"axis {axis}: the reference has no step")
    flags = int(np.bitwise_or.reduce(record["flags"].astype(np.int64)))
    return _SteppedRecord(steps, float(np.abs(record[f"{axis}_drive_v"]).max()), flags)


def _summarise_steps(height_um: float, levels_um: tuple[float, ...], runs: Sequence[_SteppedRecord]) -> SimulatedStep:
    """Return the figures of all steps of one height from several runs; limits and trips are those of any tick."""
    steps = np.vstack([run.steps for run in runs])
    all_flags = reduce(or_, (run.flags for run in runs))
    overshoot_percent, settling_ms, static_error_percent = step_quantiles(steps)
    return SimulatedStep(
        height_um,
        overshoot_percent,
        settling_ms,
        static_error_percent,
        tuple(np.median(np.where(np.isnan(steps), np.inf, steps), axis=0).tolist()),
        max(run.peak_drive_v for run in runs),
        tuple(name for flag, name in LIMIT_FLAGS.items() if all_flags & flag),
        tuple(trip_causes(all_flags)),
        (min(levels_um), max(levels_um)),
    )


def step_quantiles(steps: Real) -> tuple[float, float, float]:
    """Return the STEP_QUANTILE quantiles of overshoot (%), settling time (ms) and static error (%) of `steps` (n, 3).

    NaN, a step that missed its reference, counts as infinite: so is the quantile if there are too many.
    """
    ranked = np.where(np.isnan(steps), np.inf, steps)
    method = "linear" if np.all(np.isfinite(ranked)) else "higher"
    overshoot_percent, settling_ms, static_error_percent = np.quantile(
        ranked, STEP_QUANTILE, axis=0, method=method
    ).tolist()
    return overshoot_percent, settling_ms, static_error_percent
