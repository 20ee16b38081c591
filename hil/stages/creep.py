"""Slow creep of the piezo material: the displacement y becomes y·(1 + Σ c_i / (1 + τ_i s)).

Creep as linear dynamics (Rakotondrabe, Clévy & Lutz 2010), here a sum of first-order lags: a step of 1 µm grows by
Σ c_i µm, each share within its τ_i. The lags are exact at the sampling instants and held in between, which is right
for time constants of many periods. No lags: no creep.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rtloop.foundation.native.compiled import jit

MAX_LAGS = 8

COEFFICIENTS = [
    ("lag_count", "i8"),
    ("lag_gains", "f8", (MAX_LAGS,)),
    ("lag_shares", "f8", (MAX_LAGS,)),
]
STATE = [("lags_um", "f8", (MAX_LAGS,))]


def discretise(gains: Sequence[float], time_constants_s: Sequence[float], period_s: float) -> dict[str, object]:
    """Return the values of COEFFICIENTS by name for lags c_i, τ_i: `gains` and as many `time_constants_s`.

    A lag with the time constant τ approaches its input, in each period T, by its `lag_shares` = 1 − exp(−T/τ) of the
    difference.
    """
    padding = [0.0] * (MAX_LAGS - len(gains))
    shares = -np.expm1(-period_s / np.array(time_constants_s, dtype=float))
    return {
        "lag_count": len(gains),
        "lag_gains": np.array([*gains, *padding]),
        "lag_shares": np.append(shares, padding),
    }


@jit
def step(coefficients, state, displacement_um):
    """Return the displacement with creep [µm] for the period that begins, from the lags before it; then let the lags
    follow `displacement_um`.
    """
    crept_um = displacement_um
    for i in range(coefficients.lag_count):
        lag_um = state.lags_um[i]
        crept_um += coefficients.lag_gains[i] * lag_um
        state.lags_um[i] = lag_um + coefficients.lag_shares[i] * (displacement_um - lag_um)
    return crept_um
