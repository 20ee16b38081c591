"""Bouc-Wen hysteresis, of order 1: y = d·u − h, dh/dt = A·du/dt − B·|du/dt|·h − Γ·du/dt·|h|.

Wen 1976; for piezo cantilevers Rakotondrabe 2011, "Bouc-Wen modeling and inverse multiplicative structure to compensate
hysteresis nonlinearity in piezoelectric actuators". Unlike a sum of plays, its slope after a reversal depends on the
way before it, and minor loops drift instead of closing. It does not depend on the rate: every term is proportional to
du. The kernel integrates over the drive, in steps of at most STEP_V, by the midpoint rule.
"""

from __future__ import annotations

from rtloop.foundation.native.compiled import jit, jit_inline

STEP_V = 0.1
"""Largest step of the drive in V: the relative error of h is then about 1e-5 for B up to 1 per V."""
MAX_STEPS = 4000

COEFFICIENTS = [
    ("bw_um_per_v", "f8"),  # d, 0 for no Bouc-Wen actuator
    ("bw_rise_um_per_v", "f8"),  # A
    ("bw_decay_per_v", "f8"),  # B
    ("bw_lean_per_v", "f8"),  # Γ
]
STATE = [("bw_drive_v", "f8"), ("bw_left_um", "f8")]


@jit_inline
def _slope(coefficients, hysteretic_um, sign):
    """Return the slope dh/du in µm/V of the hysteretic part h while the drive u rises (`sign` 1) or falls (−1)."""
    magnitude_um = hysteretic_um if hysteretic_um > 0.0 else -hysteretic_um
    return (
        coefficients.bw_rise_um_per_v
        - coefficients.bw_decay_per_v * sign * hysteretic_um
        - coefficients.bw_lean_per_v * magnitude_um
    )


@jit
def step(coefficients, state, drive_v):
    """Move the actuator to `drive_v` and return its displacement [µm]. NaN leaves drive and displacement unchanged."""
    travel_v = drive_v - state.bw_drive_v
    if travel_v != 0.0 and travel_v == travel_v:
        sign = 1.0 if travel_v > 0.0 else -1.0
        steps = sign * travel_v / STEP_V
        count = int(steps) + 1 if steps < MAX_STEPS else MAX_STEPS
        substep_v, hysteretic_um = travel_v / count, state.bw_left_um
        for _ in range(count):
            middle_um = hysteretic_um + 0.5 * substep_v * _slope(coefficients, hysteretic_um, sign)
            hysteretic_um += substep_v * _slope(coefficients, middle_um, sign)
        state.bw_left_um, state.bw_drive_v = hysteretic_um, drive_v
    return coefficients.bw_um_per_v * state.bw_drive_v - state.bw_left_um
