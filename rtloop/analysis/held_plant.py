"""A plant behind a zero-order hold, from sample to sample, and exactly between samples.

The input is constant for a period. Between samples the state follows from the same plant sampled eight times as fast:
x(kT + jT/8) = c Aʲ x_k + Σ_{i<j} c Aⁱ b u_k, with A and b of T/8.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.linear.discretise import zero_order_hold
from rtloop.linear.realisation import System
from rtloop.linear.transfer import Transfer

POINTS = 8
"""Number of points within a period, the sample included, at which the position is known."""


class IntersampleOutput(NamedTuple):
    """Positions at the `POINTS` of a period, the sample first, from the states and the input.

    They are `rows` (POINTS, n) times the states plus `direct` (POINTS,) times the input.
    """

    rows: Real
    direct: Real


class HeldPlant(NamedTuple):
    """The plant from sample to sample, and its positions between samples, both from the same states."""

    system: System
    between: IntersampleOutput


def hold_plant(plant: Transfer, period_s: float, delay_ticks: int = 0) -> HeldPlant:
    """Return D(s) behind a zero-order hold and `delay_ticks` samples of delay, each of which adds a state.

    D(s) must have fewer zeros than poles, which is not checked. Raises ValueError for a negative delay and for a period
    that is not a positive number.
    """
    if delay_ticks < 0:
        raise ValueError(f"delay_ticks: {delay_ticks} samples; allowed: 0 or more")
    fine = zero_order_hold(plant, period_s / POINTS)
    row, state, input_state = fine.c, np.eye(fine.b.size), np.zeros_like(fine.b)
    rows, direct = [], []
    for _ in range(POINTS):
        rows.append(row @ state)
        direct.append(float(row @ input_state))
        state, input_state = fine.a @ state, fine.a @ input_state + fine.b
    system, between = System(state, input_state, row, fine.d), IntersampleOutput(np.array(rows), np.array(direct))
    for _ in range(delay_ticks):
        n = system.b.size
        a = np.block([[system.a, system.b[:, None]], [np.zeros((1, n + 1))]])
        between = IntersampleOutput(np.hstack([between.rows, between.direct[:, None]]), np.zeros(POINTS))
        system = System(a, np.eye(n + 1)[-1], np.append(system.c, 0.0), 0.0)
    return HeldPlant(system, between)
