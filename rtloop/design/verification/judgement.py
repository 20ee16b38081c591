"""Achieved value, limit and verdict of each quantity of a linear loop."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rtloop.analysis.closed_loop import Loop
from rtloop.analysis.margins import loop_margins
from rtloop.analysis.search import zero_between
from rtloop.analysis.step_response import step_metrics
from rtloop.design.synthesis.specification import SensorOptions, SpecificationOptions
from rtloop.foundation.arrays import Real
from rtloop.linear.matrices import stationary_covariance


class Limit(NamedTuple):
    """Upper limit (`at_most` True) or lower limit (False); infinite for an unbounded frequency range."""

    value: float
    at_most: bool

    def accepts(self, value: float) -> bool:
        """Whether `value` meets the limit, with tolerance for rounding; NaN (undefined, unstable) does not."""
        slack = 1e-9 * max(1.0, abs(self.value)) if math.isfinite(self.value) else 0.0
        return value <= self.value + slack if self.at_most else value >= self.value - slack


def required_limits(specification: SpecificationOptions) -> dict[str, Limit]:
    """Return the limit of each required quantity, keyed as in `rtloop.design.synthesis.specification.QUANTITIES`.

    The limit of `disturbance_hz` is infinite for a disturbance without `up_to_hz`.
    """
    directions = {"static_error_percent": True, "settling_ms": True, "overshoot_percent": True, "bandwidth_hz": False,
                  "modulus_margin": False, "resonance_decay_ms": True, "resonance_shift_percent": False}  # fmt: skip
    required = {
        name: Limit(value, at_most)
        for name, at_most in directions.items()
        if (value := getattr(specification, name)) is not None
    }
    if specification.command is not None:
        required["peak_command"] = Limit(specification.command.command_um / specification.command.reference_um, True)
    if specification.disturbance is not None:
        required["disturbance_hz"] = Limit(specification.disturbance.up_to_hz or math.inf, False)
    return required


def specified_quantities(
    loop: Loop, specification: SpecificationOptions, resonance: float | None = None
) -> dict[str, float]:
    """Return the quantities that a specification can limit, by name: `static_error_percent`, `settling_ms`,
    `overshoot_percent`, `peak_command` and `bandwidth_hz` (SPECIFIED), `disturbance_hz` and `modulus_margin` if they
    are specified, `resonance_decay_ms` with a `resonance`, the model's in rad/s.

    All are NaN for an unstable loop; settling and overshoot also where the static error exceeds 5 %.
    """
    conditions = {
        "disturbance_hz": specification.disturbance,
        "modulus_margin": specification.modulus_margin,
        "resonance_decay_ms": resonance,
    }
    if not loop.is_stable:
        return dict.fromkeys((*SPECIFIED, *(name for name, condition in conditions.items() if condition)), math.nan)
    step = step_metrics(loop, ())
    quantities = {
        "static_error_percent": step.static_error_percent,
        "settling_ms": 1e3 * step.settling_time_s,
        "overshoot_percent": step.overshoot_percent,
        "peak_command": step.peak_command,
        "bandwidth_hz": sensitivity_limit_hz(loop, math.sqrt(0.5)),
    }
    if specification.disturbance is not None:
        quantities["disturbance_hz"] = sensitivity_limit_hz(
            loop, specification.disturbance.error_um / specification.disturbance.largest_um
        )
    if specification.modulus_margin is not None:
        quantities["modulus_margin"] = 1 / loop_margins(loop).max_sensitivity
    if resonance is not None:
        quantities["resonance_decay_ms"] = 1e3 * slowest_near_s(loop, resonance)
    return quantities


SPECIFIED = ("static_error_percent", "settling_ms", "overshoot_percent", "peak_command", "bandwidth_hz")
"""Quantities that `specified_quantities` returns for every specification."""


NEAR_RESONANCE = (0.55, 1.85)
"""Frequency range of closed-loop modes that belong to the resonance, relative to its frequency."""


def slowest_near_s(loop: Loop, resonance: float) -> float:
    """Return 1/|Re s| in s of the slowest mode of a stable loop whose |Im s| is within NEAR_RESONANCE times `resonance`
    (rad/s), ends excluded; 0 without such a mode.
    """
    frequencies, (low, high) = np.abs(loop.rates.imag), NEAR_RESONANCE
    nearby = loop.rates[(frequencies > low * resonance) & (frequencies < high * resonance)]
    return float(np.max(-1 / nearby.real, initial=0.0))


def loop_quantities(loop: Loop, sensor: SensorOptions) -> dict[str, float]:
    """Return the quantities of a loop beside `specified_quantities`, by name: `max_re_pole` in rad/s (continuous loop)
    or `max_abs_pole` (sampled), `crossover_hz`, `phase_margin_deg`, `gain_margin` (a factor), `modulus_margin`,
    `max_sensitivity`, `sensitivity_1hz`; with sensor noise, for a stable sampled loop, `noise_x_nm`, `noise_v_nm`, rms.
    """
    margins = loop_margins(loop)
    name, magnitudes = (
        ("max_re_pole", loop.poles.real) if loop.period_s is None else ("max_abs_pole", np.abs(loop.poles))
    )
    return {
        name: float(magnitudes.max(initial=-math.inf)),
        "crossover_hz": margins.crossover_hz,
        "phase_margin_deg": margins.phase_margin_deg,
        "gain_margin": margins.gain_margin,
        "modulus_margin": 1 / margins.max_sensitivity,
        "max_sensitivity": margins.max_sensitivity,
        "sensitivity_1hz": float(loop.sensitivity(1.0)[0]),
        **_noise(loop, sensor),
    }


def sensitivity_limit_hz(loop: Loop, level: float) -> float:
    """Return the frequency in Hz up to which |S| ≤ `level` from 0 Hz on: 0 if |S| exceeds it at 0 Hz, infinite if |S|
    exceeds it nowhere.
    """
    if abs(1 / (1 + loop.static_gain)) > level:
        return 0.0
    hz = loop.frequencies
    exceeding = np.flatnonzero(loop.sensitivity(hz) > level)
    if not exceeding.size:
        return math.inf
    if exceeding[0] == 0:
        return float(hz[0])
    return zero_between(lambda f: loop.sensitivity(f) - level, float(hz[exceeding[0] - 1]), float(hz[exceeding[0]]))


def _noise(loop: Loop, sensor: SensorOptions) -> dict[str, float]:
    """Return {"noise_x_nm", "noise_v_nm"}, rms, for white sensor noise at every sample, from the stationary covariance.

    Empty in continuous time, for an unstable loop and without noise.
    """
    if loop.period_s is None or not loop.is_stable or sensor.deviation_um == 0:
        return {}
    x_nm, v_nm = (1e3 * sensor.deviation_um * noise_gains(loop)).tolist()
    return {"noise_x_nm": x_nm, "noise_v_nm": v_nm}


def noise_gains(loop: Loop) -> Real:
    """Return the rms of the true position x and of v per rms of white sensor noise, (2,), from the stationary
    covariance of a stable sampled loop.
    """
    a, b, c, d = loop.error_matrices
    covariance = c @ stationary_covariance(a, np.outer(b, b)) @ c.T
    return np.sqrt(np.diag(covariance) + d**2)
