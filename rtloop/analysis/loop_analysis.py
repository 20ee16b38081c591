"""Analysis of the loop of a controller and a plant: on paper, C(s)·D(s), and as it will run, C(z) with delay."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtloop.analysis.closed_loop import Loop
from rtloop.analysis.margins import Margins
from rtloop.analysis.step_response import step_metrics
from rtloop.values import to_jsonable

TIMES_S = (0.001, 0.002, 0.003, 0.005, 0.010)
"""Times in s after a step at which its position is reported."""


@dataclass(frozen=True)
class LoopAnalysis:
    """Margins, step figures and poles of one loop. Percentages and |S| refer to the reference; NaN: undefined or
    unstable.

    `max_re_pole` (rad/s) is NaN in discrete time, `max_abs_pole` in continuous time. `static_error_percent` is the
    magnitude (≥ 0) of the final error of a step, relative to its height. The settling time is to ±5 % of the final
    value, and overshoot counts from it.
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

    def as_dict(self) -> dict[str, object]:
        """Return the fields by name for JSON: poles as [real, imaginary], null for undefined and infinite values."""
        return to_jsonable(self)


def analyse_loop(
    loop: Loop, margin_values: Margins, delay_ticks: int, times_s: Sequence[float] = TIMES_S
) -> LoopAnalysis:
    """Return the analysis of a loop, with its margins and its positions at `times_s` after a unit step.

    `delay_ticks` is only reported: `loop` includes its delay. `poles` are in rising order of their real, then imaginary
    parts. Step figures of an unstable loop are NaN.
    """
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
