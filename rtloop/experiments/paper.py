"""Numbers to compare with: what the paper's text says, and what its printed equations give when they are recomputed.

Rakotondrabe, Aljanaideh and Al Janaideh, "H∞ control for a smart micro-positioning system with an analytical model for
the output of the inverse compensation". The recomputed numbers come from eqs (4), (5) and (20) as printed, by scripts
of numpy and scipy that share no code with this package: plays evaluated sample by sample, D(s) and C(s) from their
factors, steps from a matrix exponential at 1 µs.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from hil.linear import Complex, Real
from rtloop.design.closedloop import continuous_loop
from rtloop.design.paper import PAPER_C, PAPER_D
from rtloop.design.step import step_response
from rtloop.experiments.verdict import Said, about

LOOP_PERCENT, LOOP_HEIGHT_UM, LOOP_RANGE_UM = 14.659, 12.612, 86.037
"""h/H, h and H of eq (4) at 10 V."""
LOOP_PERCENT_HALF = 10.342
"""h/H of eq (4) at 5 V."""
LOOP_PERCENT_MINOR = 8.734
"""h/H of eq (4) between 0 and 5 V, at any history."""
FINAL_UM = 43.486
"""D(0)·y(10 V)."""
OVERSHOOT_PERCENT, RESONANCE_HZ, DAMPING = 14.474, 595.50, 0.00735
PEAK_DB, PEAK_HZ = 16.613, 595.44
"""6.8454 over D(0)."""
RESIDUAL_PERCENT, RESIDUAL_UM = 1.488, 0.747
"""h/H and the largest |v − y| for a 40 µm sine, the inverse of (4) before the actuator of (4): its dead band."""
PRINTED_INVERSE_UM = 2.918
"""The same with the inverse as printed in (6)."""
STATIC_PERCENT, SETTLING_MS, CLOSED_OVERSHOOT_PERCENT, PEAK_COMMAND = 0.166384, 4.14, 0.663, 1.3555
BANDWIDTH_HZ, HIGH_PEAK_DB = 127.19, -3.33
"""−3 dB of T, and its largest value beyond 300 Hz, at 611 Hz."""
FEEDFORWARD_DB, RAW_DB = -0.746, -5.213
"""x per command at low frequency with 2 µm, relative to 43 µm per 10 V: the fundamental of eq (4) times D(0)."""
CLOSED_DB = -0.0145
DISTURBANCE_UM, DISTURBANCE_MS, DISTURBANCE_STATIC_NM = 1.854, 56.85, 5.53
"""x after a step of 3.285 µm added before D: the largest, when it is within 100 nm, what remains."""
STABLE_SHIFT_PERCENT = (-5.65, 1.80)
"""Shifts of the resonance between which the loop is stable at 10 kHz (tustin, prewarped at 595.5 Hz)."""

SAID_LOOP = Said("16.3", about(16.3))
SAID_HEIGHT, SAID_RANGE = Said("≈ 14", about(14.0, 0.08)), Said("≈ 86", about(86.0))
SAID_FIT = Said("good agreement")
SAID_OVERSHOOT, SAID_RESONANCE = Said("9.5", about(9.5)), Said("nearly 400", about(400.0, 0.1))
SAID_RESIDUAL, SAID_HEIGHT_LEFT = Said("3.75", about(3.75)), Said("≈ 3", about(3.0, 0.1))
SAID_OMEGA = Said("< 3", (0.0, 3.0))
SAID_GAIN = Said("1", (0.99, 1.01))
SAID_SETTLING, SAID_NO_OVERSHOOT = Said("< 2 (asked: ≤ 3)", (0.0, 2.0)), Said("0", (0.0, 0.05))
SAID_STATIC, SAID_COMMAND = Said("negligible (asked: ≤ 0.1)", (0.0, 0.1)), Said("asked: ≤ 1", (0.0, 1.0))
SAID_TRACKING = Said("well ensured")
SAID_REMOVED = Said("peak completely removed", (-np.inf, 0.0))
SAID_NEGLIGIBLE = Said("≤ 100", (0.0, 100.0))


@cache
def closed_step(duration_s: float) -> tuple[Real, Real]:
    """Time in s and x after a unit step of the reference: C(s) and D(s) as printed, in continuous time."""
    found = step_response(continuous_loop(PAPER_C, PAPER_D), duration_s)
    return found.time_s, found.position


def open_step(time_s: Real) -> Real:
    """x after a unit step of y: D(s) as printed, from its residues; real on the imaginary pairs' sum."""
    s, poles = time_s[:, None], PAPER_D.poles
    residues = np.array([_residue(i) for i in range(poles.size)])
    return np.real(np.sum(residues / poles * np.expm1(poles * s), axis=1))


def _residue(i: int) -> complex:
    poles, zeros = PAPER_D.poles, PAPER_D.zeros
    others = np.delete(poles, i)
    return complex(PAPER_D.gain * np.prod((poles[i] - zeros) / (poles[i] - others)))


def dynamics(hz: Real) -> Complex:
    """D as printed."""
    return PAPER_D.response(2j * np.pi * hz)


def sensitivity(hz: Real) -> Complex:
    """S = 1/(1 + C·D) as printed."""
    return 1 / (1 + PAPER_C.response(2j * np.pi * hz) * dynamics(hz))
