"""Figures of an axis's loop on its model: margins, step response, tolerated shift of the resonance."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rtloop.analysis.loop_analysis import LoopAnalysis
from rtloop.analysis.perturbation import plant_changes, stability_range
from rtloop.analysis.step_response import step_response
from rtloop.configuration.cautions import comparison_warnings, rig_problem, tracking_problem
from rtloop.configuration.checks import AxisCheck
from rtloop.configuration.prepare import Prepared
from rtloop.configuration.simulated import compare_with_rig

STEP_POINTS = 400
STEP_SETTLINGS = 3.0
"""Length of a step, in settling times."""
LEAST_STEP_PERIODS = 30

Figures = dict[str, Any]


def loop_figures(prepared: Prepared, number: int, least_step_ms: float = 0.0) -> Figures:
    """Return figures of the loop of axis `number`, from 0; its step lasts at least `least_step_ms`.

    Keys: gain_margin_db, phase_margin_deg, modulus_margin, crossover_hz, tolerated_shift_percent as
    `_tolerated_shift_percent` returns it, overshoot_percent, settling_ms, static_error_percent, step, problems. A
    figure that does not exist is None; without a stable linear loop, all are None but `problems`.

    The loop is the loop of `running_check`: on the axis's model or on the simulated rig. `problems` lists warnings and
    contradictions of the axis, and faults of its loop: unstable, or not following the reference. `step` is {t_ms, y} as
    in `_step_figures`.
    """
    axis, promised = prepared.configuration.axes[number], prepared.checks[number]
    check = running_check(prepared, number)
    result: Figures = dict.fromkeys(
        ("gain_margin_db", "phase_margin_deg", "modulus_margin", "crossover_hz", "tolerated_shift_percent",
         "overshoot_percent", "settling_ms", "static_error_percent", "step")
    )  # fmt: skip
    result["problems"] = [warning for warning in prepared.warnings if warning.startswith(f"axis.{axis.name}.")]
    result["problems"] += comparison_warnings(promised)
    if (problem := tracking_problem(promised)) is not None:
        result["problems"].append(f"axis.{axis.name}.controller: {problem}")
    comparison = compare_with_rig(prepared.configuration, axis, promised)
    result["problems"] += comparison.contradictions
    if (problem := rig_problem(axis, promised, comparison)) is not None:
        result["problems"].append(problem)
    analysis = check.running
    if analysis is None or not analysis.stable:
        return result
    result |= {
        "crossover_hz": analysis.crossover_hz,
        "phase_margin_deg": analysis.phase_margin_deg,
        "gain_margin_db": 20 * math.log10(analysis.gain_margin),
        "modulus_margin": 1 / analysis.max_sensitivity,
        "overshoot_percent": analysis.overshoot_percent,
        "settling_ms": 1e3 * analysis.settling_time_s,
        "static_error_percent": analysis.static_error_percent,
        "tolerated_shift_percent": _tolerated_shift_percent(check),
        "step": _step_figures(check, analysis, 1e-3 * least_step_ms),
    }
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in result.items()
    }


def running_check(prepared: Prepared, number: int) -> AxisCheck:
    """Return the check of the loop of axis `number`, from 0: on the simulated rig, if the axis's keys contradict the
    rig or the loop is unstable on the rig; else, and without a simulated rig, on the axis's model.
    """
    check = prepared.checks[number]
    return compare_with_rig(prepared.configuration, prepared.configuration.axes[number], check).on_rig or check


def _tolerated_shift_percent(check: AxisCheck) -> list[float] | None:
    """Return [down ≤ 0, up ≥ 0]: the shifts of the plant's resonance, %, between which the loop stays stable.

    An end is -50 or 50, where the search ends, if the loop stays stable up to there. None without a resonance.
    """
    resonance = None if check.plant is None else plant_changes(check.plant).get("resonance")
    if check.plant is None or resonance is None:
        return None
    down, up = stability_range(lambda plant: check.loop(plant, check.delay_ticks), check.plant, resonance)
    return [-(resonance.down if down is None else down), resonance.up if up is None else up]


def step_duration_ms(figures: Figures) -> float:
    """Return the duration, ms, of the step response in `figures` of `loop_figures`; 0 without a response."""
    return figures["step"]["t_ms"][-1] if figures["step"] else 0.0


def lengthen_step(figures: Figures, check: AxisCheck, end_ms: float) -> Figures:
    """Return a copy of `figures`, a result of `loop_figures`, whose step response lasts at least `end_ms`.

    The response is computed again from `check`, the `running_check` of the axis. Returns `figures` itself without a
    step response, or with one that is long enough.
    """
    if check.running is None or not 0 < step_duration_ms(figures) < end_ms:
        return figures
    return figures | {"step": _step_figures(check, check.running, 1e-3 * end_ms)}


def _step_figures(check: AxisCheck, analysis: LoopAnalysis, min_duration_s: float) -> dict[str, list[float]] | None:
    """Return the response to a step of 1 µm, {t_ms, y (µm)}, STEP_POINTS samples over at least `min_duration_s`.

    None without a discrete-time loop on a model, and if the loop does not settle.
    """
    loop = check.on_model
    if loop is None or loop.period_s is None or not math.isfinite(analysis.settling_time_s):
        return None
    duration_s = max(STEP_SETTLINGS * analysis.settling_time_s, LEAST_STEP_PERIODS * loop.period_s, min_duration_s)
    response = step_response(loop, duration_s)
    time_s = np.linspace(0.0, duration_s, STEP_POINTS)
    position_um = np.interp(time_s, response.time_s, response.position)
    return {"t_ms": (1e3 * time_s).round(6).tolist(), "y": position_um.round(9).tolist()}
