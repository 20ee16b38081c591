"""Analysis of the loop of a controller and a plant: on paper, C(s)·D(s), and as it will run, C(z) with delay."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from rtloop.analysis.closed_loop import Loop, continuous_loop, discrete_loop
from rtloop.analysis.margins import Margins, loop_margins
from rtloop.analysis.step_response import step_metrics
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.sampled import SampledController
from rtloop.linear.transfer import Transfer

TIMES_S = (0.001, 0.002, 0.003, 0.005, 0.010)
"""When the step response is reported."""


@dataclass(frozen=True)
class LoopAnalysis:
    """What there is to know about one loop. Percentages and |S| refer to the reference; NaN: undefined or unstable.

    `max_re_pole` (rad/s) is NaN in discrete time, `max_abs_pole` in continuous time. `static_error_percent` is
    what a step leaves, relative to its height. The settling time is that to ±5 % of the final value, and overshoot
    counts from it.
    """

    period_s: float | None
    delay_ticks: int
    stable: bool
    max_re_pole: float
    max_abs_pole: float
    static_error_percent: float
    crossover_hz: float
    phase_margin_deg: float
    gain_margin: float
    gain_margin_hz: float
    max_sensitivity: float
    max_sensitivity_hz: float
    sensitivity_1hz: float
    settling_time_s: float
    overshoot_percent: float
    peak_command: float
    step_times_s: tuple[float, ...]
    step_position: tuple[float, ...]
    poles: tuple[complex, ...]

    def as_dict(self) -> dict[str, Any]:
        """For JSON: poles as [real, imaginary], null for what is undefined or without limit."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: _json_value(value) for name, value in values.items()}


def analyse_continuous(controller: Transfer, plant: Transfer, times_s: Sequence[float] = TIMES_S) -> LoopAnalysis:
    """C(s) and D(s) without sampling or delay. Raises ValueError for a plant with direct feedthrough."""
    loop = continuous_loop(controller, plant)
    return analyse_loop(loop, loop_margins(loop), 0, times_s)


def analyse_discrete(
    controller: DiscreteController | SampledController,
    plant: Transfer,
    delay_ticks: int = 0,
    times_s: Sequence[float] = TIMES_S,
) -> LoopAnalysis:
    """C(z) and D(s) behind a zero-order hold, at the controller's period, with `delay_ticks` samples between them.

    No delay is the least there can be: a command computed from a sample shows in the next one. Raises ValueError for
    a plant with direct feedthrough.
    """
    loop = discrete_loop(controller, plant, delay_ticks)
    return analyse_loop(loop, loop_margins(loop), delay_ticks, times_s)


def analyse_loop(
    loop: Loop, margin_values: Margins, delay_ticks: int, times_s: Sequence[float] = TIMES_S
) -> LoopAnalysis:
    """A loop that is put together already, with the margins that were found of it."""
    continuous = loop.period_s is None
    poles = loop.poles[np.lexsort((loop.poles.imag, loop.poles.real))]
    step = step_metrics(loop, times_s)
    return LoopAnalysis(
        period_s=loop.period_s,
        delay_ticks=delay_ticks,
        stable=loop.is_stable,
        max_re_pole=float(poles.real.max(initial=-math.inf)) if continuous else math.nan,
        max_abs_pole=math.nan if continuous else float(np.abs(poles).max(initial=0.0)),
        static_error_percent=step.static_error_percent,
        sensitivity_1hz=float(loop.sensitivity(1.0)[0]),
        settling_time_s=step.settling_time_s,
        overshoot_percent=step.overshoot_percent,
        peak_command=step.peak_command,
        step_times_s=tuple(float(t) for t in times_s),
        step_position=step.position_at,
        poles=tuple(complex(p) for p in poles),
        **margin_values._asdict(),
    )


def _json_value(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_json_value(item) for item in value]
    if isinstance(value, complex):
        return [value.real, value.imag]
    return None if isinstance(value, float) and not math.isfinite(value) else value
