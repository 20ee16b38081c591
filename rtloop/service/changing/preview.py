"""What a change would make of an axis's loop on its model: margins, step, how far its resonance may shift."""

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
from rtloop.configuration.simulated import compare_with_rig, contradictions

STEP_POINTS = 400
STEP_SETTLINGS = 3.0
"""A step is shown for so many times as long as it settles."""
LEAST_STEP_PERIODS = 30

Figures = dict[str, Any]


def figures(prepared: Prepared, number: int, least_step_ms: float = 0.0) -> Figures:
    """Of the loop of axis `number` as it will run; null for what does not exist. Its step lasts for `least_step_ms`
    at least.

    The loop is that on the axis's model, or on the simulated rig where the axis contradicts it. The shift of the
    resonance is looked for up to ∓50 %. `problems` are the axis's warnings, its contradictions, and that the loop is
    unstable or does not follow its reference.
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
    result["problems"] += contradictions(prepared.configuration, axis, promised)
    if (problem := rig_problem(prepared.configuration, axis, promised)) is not None:
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
        "step": _step(check, analysis, 1e-3 * least_step_ms),
    }
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in result.items()
    }


def running_check(prepared: Prepared, number: int) -> AxisCheck:
    """Return axis `number` on the simulated rig where it contradicts the rig, else on its model."""
    check = prepared.checks[number]
    return compare_with_rig(prepared.configuration, prepared.configuration.axes[number], check).on_rig or check


def _tolerated_shift_percent(check: AxisCheck) -> list[float] | None:
    """Of the model's resonance, downwards and upwards; None where it has none."""
    resonance = None if check.plant is None else plant_changes(check.plant).get("resonance")
    if check.plant is None or resonance is None:
        return None
    down, up = stability_range(lambda plant: check.loop(plant, check.delay_ticks), check.plant, resonance)
    return [-(resonance.down if down is None else down), resonance.up if up is None else up]


def step_end_ms(found: Figures) -> float:
    """The last moment of the step in figures; 0 where they have none."""
    return found["step"]["t_ms"][-1] if found["step"] else 0.0


def with_longer_step(found: Figures, check: AxisCheck, end_ms: float) -> Figures:
    """Figures of the axis of `check` whose step, where they have one, lasts until `end_ms` at least."""
    if check.running is None or not 0 < step_end_ms(found) < end_ms:
        return found
    return found | {"step": _step(check, check.running, 1e-3 * end_ms)}


def _step(check: AxisCheck, running: LoopAnalysis, least_s: float) -> dict[str, list[float]] | None:
    """Of 1 µm, at STEP_POINTS moments; None for a loop that does not settle."""
    loop = check.on_model
    if loop is None or loop.period_s is None or not math.isfinite(running.settling_time_s):
        return None
    duration_s = max(STEP_SETTLINGS * running.settling_time_s, LEAST_STEP_PERIODS * loop.period_s, least_s)
    response = step_response(loop, duration_s)
    time_s = np.linspace(0.0, duration_s, STEP_POINTS)
    position_um = np.interp(time_s, response.time_s, response.position)
    return {"t_ms": (1e3 * time_s).round(6).tolist(), "y": position_um.round(9).tolist()}
