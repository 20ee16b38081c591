"""Effects of the loop's rate on continuous-time synthesis: dead time of the plant, and roots too fast to matter.

exp(−sτ) ≈ N(−sτ)/N(sτ),   N(x) = Σ_k (2n − k)! n!/((2n)! k! (n − k)!) x^k       Padé 1892, order n of both
s − z → −z,   1/(s − p) → −1/p                                                   roots far beyond the rate
"""

from __future__ import annotations

import math

import numpy as np

from rtloop.analysis.closed_loop import discrete_loop
from rtloop.analysis.margins import loop_margins
from rtloop.foundation.arrays import Complex
from rtloop.laws.shipped.transfer import MAX_ORDER
from rtloop.linear.discretise import Method, discretise_controller
from rtloop.linear.transfer import Transfer

FAR_FACTOR = 1000.0
"""Multiple of half the sampling rate beyond which a root is dropped: it turns the phase there by less than 0.06°."""
MOST_DEAD_TIME_ORDER = 6
"""Largest order of Padé's all-pass."""
LARGEST_SENSITIVITY = 3.0
"""Largest max |S| of a loop that is written: L stays 1/3 away from −1. Textbooks recommend 2."""


def dead_time(delay_s: float, order: int) -> Transfer:
    """Return Padé's all-pass for exp(−s·delay_s) with `order` poles, but at most MOST_DEAD_TIME_ORDER.

    It is 1 for a delay of 0 and for an order of 0.
    """
    n = min(order, MOST_DEAD_TIME_ORDER)
    if delay_s == 0 or n == 0:
        return Transfer.from_zpk([], [], 1.0)
    factorial = math.factorial
    coefficients = [
        factorial(2 * n - k) * factorial(n) / (factorial(2 * n) * factorial(k) * factorial(n - k)) for k in range(n + 1)
    ]
    poles = np.roots(coefficients[::-1]) / delay_s
    return Transfer.from_zpk(-poles, poles, (-1.0) ** n)


def drop_fast_roots(transfer: Transfer, rate_hz: float) -> Transfer:
    """Return the transfer function without roots beyond FAR_FACTOR times half of `rate_hz`; the gain at 0 Hz is
    preserved.

    Unstable poles stay; so do all poles if fewer than the remaining zeros would be left.
    """
    limit = FAR_FACTOR * math.pi * rate_hz
    zeros, dropped_zeros = _split_roots(transfer.zeros, np.abs(transfer.zeros) <= limit)
    poles, dropped_poles = _split_roots(transfer.poles, (np.abs(transfer.poles) <= limit) | (transfer.poles.real >= 0))
    if zeros.size > poles.size:
        poles, dropped_poles = transfer.poles, poles[:0]
    gain = complex(transfer.gain)
    for zero in dropped_zeros:
        gain *= -zero
    for pole in dropped_poles:
        gain /= -pole
    return Transfer(zeros, poles, gain.real)


def is_runnable(
    controller: Transfer, plant: Transfer, rate_hz: float, method: Method, prewarp_hz: float | None, delay_ticks: int
) -> bool:
    """Whether C(z) with the plant, its hold and its delay is stable at this rate, with max |S| ≤ LARGEST_SENSITIVITY.

    False too for an order above MAX_ORDER and if no C(z) exists. Near half the rate C(z) differs from C(s); with a
    lightly damped mode there, a loop may be stable on the model and unstable on the stage.
    """
    if controller.order > MAX_ORDER:
        return False
    try:
        discrete = discretise_controller(controller, 1 / rate_hz, method, prewarp_hz)
    except ValueError:
        return False
    loop = discrete_loop(discrete, plant, delay_ticks)
    return loop.is_stable and loop_margins(loop).max_sensitivity <= LARGEST_SENSITIVITY


def _split_roots(roots: Complex, mask: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> tuple[Complex, Complex]:
    """Return the roots for which `mask` is True, then the others."""
    return roots[mask], roots[~mask]
