"""Exact discretisation for an input that is held between samples, or that is linear between samples.

`rtloop.foundation.modal.ModalSystem.zero_order_hold` discretises a sum of modes for a held input. This module has the
linear input for a sum of modes, and both inputs for matrices.
"""

from __future__ import annotations

import math

import numpy as np

from rtloop.foundation.arrays import Complex
from rtloop.foundation.modal import ModalSystem
from rtloop.linear.realisation import System


def first_order_hold(modal: ModalSystem, period_s: float) -> ModalSystem:
    """Return a sum of modes in z, exact for an input that is linear between samples (ramp invariant).

    With x = pT, φ₁ = (eˣ − 1)/x and φ₂ = (φ₁ − 1)/x, a mode r/(s − p) becomes rTφ₂ + rTφ₁²/(z − eˣ): the triangle hold
    (z − 1)²/(Tz)·Z{G(s)/s²} of Franklin, Powell & Workman, Digital Control of Dynamic Systems, and 1 + xφ₂ = φ₁.
    """
    x = modal.poles * period_s
    first, second = _phi(x)
    direct = modal.direct + (modal.residues * period_s * second).sum(axis=1).real
    return ModalSystem(np.exp(x), modal.residues * period_s * first**2, direct)


def _phi(x: Complex) -> tuple[Complex, Complex]:
    """Return φ₁ and φ₂ of `first_order_hold` at x, each in its shape, by series where the differences would cancel."""
    small = np.abs(x) < 1
    inside, outside = np.where(small, x, 0), np.where(small, 1, x)
    second = sum((inside**k / math.factorial(k + 2) for k in range(18)), np.zeros_like(x))
    first_outside = np.expm1(outside) / outside
    first = np.where(small, 1 + inside * second, first_outside)
    return first, np.where(small, second, (first_outside - 1) / outside)


def hold_matrices(system: System, period_s: float, ramp: bool) -> System:
    """Return a discretised state space, for a held input, or with `ramp` for a linear one; A stays upper
    quasi-triangular.

    The exponential of [A b 0; 0 0 1/T; 0 0 0]·T contains the responses to a step and to a ramp (Van Loan 1978).
    """
    from scipy.linalg import expm  # a tenth of a second of import, for controllers with repeated poles alone

    n = system.b.size
    joint = np.zeros((n + 2, n + 2))
    joint[:n, :n], joint[:n, n], joint[n, n + 1] = system.a * period_s, system.b * period_s, 1.0
    grown = np.asarray(expm(joint), dtype=np.float64)
    a = np.where(np.triu(np.ones((n, n))) + (system.a != 0) > 0, grown[:n, :n], 0.0)
    if not ramp:
        return System(a, grown[:n, n], system.c, system.d)
    step, slope = grown[:n, n], grown[:n, n + 1]
    return System(a, step - slope + a @ slope, system.c, system.d + float(system.c @ slope))
