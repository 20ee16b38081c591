"""A disturbance Ω added to the actuator's displacement, y + Ω, as eq (7) of the paper adds the residual hysteresis.

    Ω(t) = step + amplitude·sin(2π·frequency·(t − start))  from `start` on, held over each period

The sine is a phasor turned by a fixed angle each period, computed once: no libm in the kernel. Rounding changes its
amplitude by about 1e-16 a turn. The owner of the state may also set `disturbance_um`, a constant that is added.
"""

from __future__ import annotations

import math

from rtloop.foundation.native.compiled import jit

COEFFICIENTS = [
    ("disturbance_step_um", "f8"),
    ("disturbance_cos", "f8"),
    ("disturbance_sin", "f8"),
]
STATE = [("disturbance_um", "f8"), ("disturbance_wait", "i8"), ("sine_um", "f8"), ("cosine_um", "f8")]


def discretise(step_um: float, sine_um: float, sine_hz: float, period_s: float) -> dict[str, object]:
    """Return the values of COEFFICIENTS by name.

    The amplitude `sine_um` is no coefficient: it is the initial value of `cosine_um` in STATE, which the caller sets.
    Raises ValueError for a `sine_hz` of half the sampling rate or more, unless `sine_um` is 0.
    """
    if sine_um and sine_hz >= 0.5 / period_s:
        raise ValueError(f"sine_hz: {sine_hz:g} Hz; allowed: less than {0.5 / period_s:g} Hz, half the rate")
    angle = 2 * math.pi * sine_hz * period_s
    return {
        "disturbance_step_um": step_um,
        "disturbance_cos": math.cos(angle),
        "disturbance_sin": math.sin(angle),
    }


@jit
def step(coefficients, state):
    """Return the disturbance [µm] for the period that begins, and advance the sine.

    While `disturbance_wait` is above 0, a call counts it down by one and returns `disturbance_um` alone.
    """
    if state.disturbance_wait > 0:
        state.disturbance_wait -= 1
        return state.disturbance_um
    sine_um, cosine_um = state.sine_um, state.cosine_um
    state.sine_um = coefficients.disturbance_cos * sine_um + coefficients.disturbance_sin * cosine_um
    state.cosine_um = coefficients.disturbance_cos * cosine_um - coefficients.disturbance_sin * sine_um
    return state.disturbance_um + coefficients.disturbance_step_um + sine_um
