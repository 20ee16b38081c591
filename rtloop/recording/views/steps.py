"""Step metrics from recorded positions: overshoot, settling time, static error of each step of the reference."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt

SETTLING_BAND = 0.05
SMALLEST_TRAVEL = 0.5
"""A step that moves the position by a smaller fraction of its height is no step of the position."""
MAX_STEPS = 10_000
SMALLEST_DWELL_TICKS = 20


@dataclass(frozen=True)
class StepMetrics:
    """Medians and worst cases over the steps of one axis; percentages refer to the height of the step.

    A step that ends further than SETTLING_BAND of its height from its reference, or moves the position by less than
    SMALLEST_TRAVEL of its height, never settles: its settling time is infinite and it has no overshoot. `unreached`
    counts such steps; a single one makes both figures of the overshoot NaN.
    """

    steps: int
    unreached: int
    overshoot_percent: float
    overshoot_percent_worst: float
    settling_time_ms: float
    settling_time_ms_worst: float
    static_error_percent: float
    static_error_percent_worst: float

    def as_dict(self) -> dict[str, float | None]:
        """Metrics as a dict for JSON; an infinite settling time and a missing overshoot become None."""
        return {name: value if math.isfinite(value) else None for name, value in asdict(self).items()}


def step_metrics(
    reference_um: npt.NDArray[np.float64], position_um: npt.NDArray[np.float64], rate_hz: float
) -> StepMetrics | None:
    """Medians and worst cases over the steps of a piecewise constant reference (n,) with position (n,).

    None without a step of SMALLEST_DWELL_TICKS or more, or with more than MAX_STEPS changes of the reference.
    """
    table = measure_steps(reference_um, position_um, rate_hz)
    if table is None:
        return None
    unreached = int(np.count_nonzero(np.isinf(table[:, 1])))
    median, maximum = np.median(table, axis=0), np.max(table, axis=0)
    pairs = (float(value) for pair in zip(median, maximum, strict=True) for value in pair)
    return StepMetrics(len(table), unreached, *pairs)


def measure_steps(
    reference_um: npt.NDArray[np.float64], position_um: npt.NDArray[np.float64], rate_hz: float
) -> npt.NDArray[np.float64] | None:
    """Return (steps, 3): overshoot (%), settling time (ms) and static error (%) of each step of the reference, all ≥ 0.

    The level reached is the mean position over the last fifth of a step. Settling is to ±5 % of the step's height about
    that level. If the level is further than this from the reference, the settling time is infinite and the overshoot
    NaN; likewise if the position moves by less than SMALLEST_TRAVEL of the height, and then the static error is at
    least the fraction not travelled. Steps of less than SMALLEST_DWELL_TICKS are left out, and a last step that the end
    of the recording cuts off: it is shorter than all others. None if no step remains, or with more than MAX_STEPS
    changes of the reference.
    """
    starts = np.flatnonzero(np.diff(reference_um) != 0) + 1
    if starts.size == 0 or starts.size > MAX_STEPS:
        return None
    ends = np.append(starts[1:], reference_um.size)
    if starts.size > 1 and ends[-1] - starts[-1] < np.diff(starts).min():
        starts, ends = starts[:-1], ends[:-1]
    rows = []
    for start, end in zip(starts, ends, strict=True):
        if end - start >= SMALLEST_DWELL_TICKS:
            height = reference_um[start] - reference_um[start - 1]
            rows.append(measure_step(position_um[start - 1 : end], reference_um[start], height, rate_hz))
    return np.array(rows) if rows else None


def measure_step(
    position_um: npt.NDArray[np.float64], level_um: float, height_um: float, rate_hz: float
) -> tuple[float, float, float]:
    """Return overshoot %, settling time ms and static error % of one step of the reference to `level_um`.

    `height_um`, not 0, is the change of the reference, negative for a step down. The first of `position_um` (n,) is the
    position before the step. Definitions and infinite or missing figures are the same as in `measure_steps`.
    """
    before_um, position_um = position_um[0], position_um[1:]
    final_um = float(np.mean(position_um[-max(1, position_um.size // 5) :]))
    static_error, travel = abs(final_um - level_um) / abs(height_um), (final_um - before_um) / height_um
    if travel < SMALLEST_TRAVEL:
        return math.nan, math.inf, 100 * max(static_error, 1 - travel)
    if static_error > SETTLING_BAND:
        return math.nan, math.inf, 100 * static_error
    overshoot_um = (position_um - final_um) * np.sign(height_um)
    unsettled = np.flatnonzero(np.abs(position_um - final_um) > SETTLING_BAND * abs(height_um))
    settled_ticks = int(unsettled[-1]) + 1 if unsettled.size else 0
    return (
        max(0.0, 100 * float(np.max(overshoot_um)) / abs(height_um)),
        1000 * settled_ticks / rate_hz,
        100 * static_error,
    )
