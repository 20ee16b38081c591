"""Simulated steps and rest: the law itself, with hysteresis, limits, rounding and noise.

Positions are the true ones, without sensor noise, also between ticks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from itertools import pairwise
from operator import or_
from typing import NamedTuple

import numpy as np

from rtloop.analysis.held_plant import POINTS
from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.reference_options import StepsOptions
from rtloop.design.synthesis.specification import DesignOptions
from rtloop.design.verification.bench import Bench
from rtloop.design.verification.judgement import required_limits
from rtloop.design.verification.simulated_steps import (
    JUDGED_QUANTITIES,
    STEP_QUANTILE,
    SimulatedStep,
    SimulationResult,
)
from rtloop.foundation.arrays import Real
from rtloop.hysteresis.reach import PositionRange, can_hold, reachable_range
from rtloop.recording.views.steps import measure_steps
from rtloop.signals import Flag, trip_causes

SHORTEST_DWELL_S, LONGEST_DWELL_S, TIME_CONSTANTS = 0.1, 1.0, 12.0
"""Dwell at a level: TIME_CONSTANTS times the slowest time constant, within these limits."""
MOST_LEVELS = 8
"""Most levels of an axis's own reference that are simulated."""
REST_S, SETTLING_S = 2.0, 0.5
"""Duration of the evaluation at rest, and of the settling before it."""
REST_PLACES = (0.03, 0.12, 0.24, 0.48)
"""Levels for the evaluation at rest, as fractions of the longer side of the range."""
CYCLES, DRAWS, MORE_DRAWS = 12, 2, 8
"""Repetitions of four steps in a run; number of runs, each with its own noise; number of runs in all if noise
determines the figures.
"""
LIMIT_FLAGS = {Flag.COMMAND_LIMITED: "command", Flag.DRIVE_LIMITED: "drive", Flag.SLEW_LIMITED: "slew"}


def simulate(bench: Bench, axis: AxisOptions, slowest_s: float, design: DesignOptions) -> SimulationResult:
    """Simulate steps and rest of an axis; `slowest_s` is 1/|Re s| in s of the slowest mode of its linear loop.

    Each height is simulated where `_levels` places it, and the axis's own reference as it is; heights that fit nowhere
    are omitted. A height whose figures noise decides is run more often. Raises ValueError for a run whose recorded
    reference has no step, and for a hysteresis model without inverse.
    """
    dwell_s = min(max(TIME_CONSTANTS * slowest_s, SHORTEST_DWELL_S), LONGEST_DWELL_S)
    command_range = _command_range(axis)
    counted_um = design.counted_heights_um
    levels_by_height = {height: _levels(axis, command_range, height) for height in sorted(set(design.step_heights_um))}
    if (own_levels := _own_levels(axis)) and design.simulation.judged is not False:
        height_um = max(abs(after - before) for before, after in pairwise((*own_levels, own_levels[0])))
        levels_by_height[height_um] = own_levels
        counted_um = (*counted_um, height_um)
    simulated_steps = []
    for height, levels in sorted(levels_by_height.items()):
        if levels is None:
            continue
        steps = [_run_steps(bench, axis.name, levels, dwell_s, draw) for draw in range(DRAWS)]
        step = _summarise_steps(height, levels, steps)
        if not all(step.is_repeatable(name) for name in JUDGED_QUANTITIES):
            steps += [_run_steps(bench, axis.name, levels, dwell_s, draw) for draw in range(DRAWS, MORE_DRAWS)]
            step = _summarise_steps(height, levels, steps)
        simulated_steps.append(step)
    truth = "the configured rig" if bench.is_configured else "a rig built from the axis's models"
    omitted = tuple(height for height, levels in levels_by_height.items() if levels is None)
    noise_x_nm, noise_v_nm = _noise_at_rest_nm(bench, axis.name, max(command_range, key=abs))
    return SimulationResult(
        truth, tuple(simulated_steps), omitted, command_range, noise_x_nm, noise_v_nm,
        required_limits(design.specification), counted_um,
    )  # fmt: skip


def _noise_at_rest_nm(bench: Bench, axis: str, reach_um: float) -> list[float]:
    """Return the rms noise of position and command at rest in nm, over all REST_PLACES: in a dead band a loop may hunt.

    The places are fractions of `reach_um`, the end of the longer side of the range (below 0 if that is the negative
    side).
    """
    squares = []
    for place in REST_PLACES:
        record = bench.run(axis, (place * reach_um,), SETTLING_S + REST_S)
        settled = slice(round(SETTLING_S * bench.rate_hz), None)
        squares.append([record[f"{axis}_{name}"][settled].var() for name in ("true_position_um", "command_um")])
    return [float(1e3 * np.sqrt(mean)) for mean in np.mean(squares, axis=0)]


def _command_range(axis: AxisOptions) -> PositionRange:
    """Return the range of static commands in µm that limits and drive allow, whatever command came before.

    Raises ValueError for a hysteresis model without inverse.
    """
    limits = axis.limits
    return reachable_range(axis.feedforward.actuator(), limits.lowest_v, limits.drive_v, limits.command_um)


def _levels(axis: AxisOptions, command_range: PositionRange, height_um: float) -> tuple[float, ...] | None:
    """Return the levels in µm of one cycle of steps of a height; None for a height that the range has no room for.

    The levels lie on both sides of 0 where the drive can hold them. In a range with unequal sides they otherwise lie
    between 0 and a level on the longer side, or for larger heights around the middle of the range. With a drive from 0
    V up, all lie around the middle, away from the drive's end at 0 V and from the remanence. Raises ValueError for a
    hysteresis model without inverse.
    """
    limits, actuator, (low_um, high_um) = axis.limits, axis.feedforward.actuator(), command_range
    middle_um = (low_um + high_um) / 2
    candidates = [
        (height_um, 0.0, -height_um, 0.0),
        2 * (math.copysign(height_um, middle_um), 0.0),
        2 * (middle_um + height_um / 2, middle_um - height_um / 2),
    ]
    if low_um == -high_um:
        candidates = candidates[:1]
    elif limits.lowest_v == 0.0:
        candidates = candidates[2:] if height_um <= command_range.span_um else []
    for levels in candidates:
        if max(map(abs, levels)) <= limits.command_um and can_hold(actuator, levels, limits.lowest_v, limits.drive_v):
            return levels
    return None


def _own_levels(axis: AxisOptions) -> tuple[float, ...]:
    """Return the levels in µm of an axis's own reference; () for one without steps, or with more than MOST_LEVELS."""
    if not isinstance(axis.reference, StepsOptions):
        return ()
    levels = axis.reference.levels
    return levels if len(levels) <= MOST_LEVELS and len(set(levels)) > 1 else ()


class _SteppedRecord(NamedTuple):
    """Overshoot (%), settling time (ms) and static error (%) of each step, (steps, 3), largest |drive| in V, and the
    flags of all ticks combined, without limits on the way to the first level.
    """

    steps: Real
    peak_drive_v: float
    flags: int


def _run_steps(bench: Bench, axis: str, levels_um: tuple[float, ...], dwell_s: float, draw: int) -> _SteppedRecord:
    """Run CYCLES cycles of steps through the levels, beginning at the last level; return the figures of each step.

    `draw` is added to the seed of the noise. Raises ValueError if the recorded reference has no step.
    """
    record = bench.run(axis, (levels_um[-1], *CYCLES * levels_um), dwell_s, draw)
    reference = np.repeat(record[f"{axis}_reference_um"], POINTS)
    steps = measure_steps(reference, bench.true_positions(record, axis).ravel(), POINTS * bench.rate_hz)
    if steps is None:
        raise ValueError(f"axis {axis}: the reference has no step")
    flags = record["flags"].astype(np.int64)
    flags[: round(dwell_s * bench.rate_hz)] &= ~int(reduce(or_, LIMIT_FLAGS))  # on the way from 0 to the first level
    peak_drive_v = float(np.abs(record[f"{axis}_drive_v"]).max())
    return _SteppedRecord(steps, peak_drive_v, int(np.bitwise_or.reduce(flags)))


def _summarise_steps(height_um: float, levels_um: tuple[float, ...], runs: Sequence[_SteppedRecord]) -> SimulatedStep:
    """Return the figures of all steps of one height from several runs; trips count in all ticks, active limits only
    after the first level is held.
    """
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

    NaN, a step that missed its reference, counts as infinite; the quantile is infinite if there are too many of them.
    """
    ranked = np.where(np.isnan(steps), np.inf, steps)
    method = "linear" if np.all(np.isfinite(ranked)) else "higher"
    overshoot_percent, settling_ms, static_error_percent = np.quantile(
        ranked, STEP_QUANTILE, axis=0, method=method
    ).tolist()
    return overshoot_percent, settling_ms, static_error_percent
