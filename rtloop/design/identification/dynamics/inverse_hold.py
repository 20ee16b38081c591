"""Back from sampled modes to continuous ones: the inverse of the zero-order hold, exact for each mode.

    s = log(z)/T,     r_s = r_z s/(e^sT − 1)

Each mode is converted alone, so that accuracy depends neither on their number nor on their distance; the principal
logarithm puts every pole below half the sampling rate.
"""

from __future__ import annotations

import numpy as np

from rtloop.foundation.arrays import Complex, Real
from rtloop.foundation.modal import ModalSystem


def continuous_modal(rates: Complex, residues: Complex, direct: Real, period_s: float) -> ModalSystem:
    """Return the sum of modes in s, with poles `rates` (n,) in rad/s, whose zero-order hold has `residues` (m, n) in z.

    r_s = r_z s/(e^sT − 1); `direct` (m,) is the direct gain of both.
    """
    x = rates * period_s
    hold_factor = np.where(x == 0, 1.0, np.expm1(x) / np.where(x == 0, 1.0, x))
    return ModalSystem(rates, residues / (period_s * hold_factor), direct)
