"""What a model errs by where a recording's memory is not known: with that memory which suits this part best.

    F_i,k = min(max(u_0 + Σ_{j≤i} d_j, low_ik), high_ik),     |d_j| ≤ r_j − r_{j−1}

low and high are the plays that began at u_0 − r and at u_0 + r (clips in succession are one clip), d the rises of the
memory curve. They are found for every other piece, and judged on those between. So free is this memory that the error
says little of the slopes, and nothing of these is taken from it.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from rtloop.design.identification.hysteresis.held_out import PIECES
from rtloop.design.identification.hysteresis.least_squares import Common, Equations, errors
from rtloop.design.identification.hysteresis.stretches import Kept, averaged_plays
from rtloop.hil.modal import Real
from rtloop.hysteresis.unknown_memory import settled_memory

WITHIN = 0.999
"""Part of its bounds in which a rise begins."""


def early_errors(run: Kept, one: Equations, common: Common, own: Real, thresholds: Real) -> Real:
    """In µm (blocks,); NaN where memory is known."""
    early_um = np.full(one.known.size, np.nan)
    if one.known.all() or not one.known.any():
        return early_um
    first_v, gaps = float(run.full_v[0]), np.maximum(np.diff(thresholds, prepend=0.0), 1e-9)
    low, high = (averaged_plays(run, thresholds, first_v + side * thresholds) for side in (-1.0, 1.0))
    weights = np.diff(common.slopes, prepend=0.0)
    position = errors(one, common, own) + one.slopes @ common.slopes

    def left(unknown: Real) -> Real:
        return position - unknown[-1] - np.clip(first_v + np.cumsum(unknown[:-1]), low, high) @ weights

    settled_rises = np.diff(settled_memory(run.full_v, thresholds), prepend=first_v)
    starts = [settled_rises, np.zeros(gaps.size), 0.5 * gaps, -0.5 * gaps]
    inner_bounds, bounds = WITHIN * gaps, np.append(gaps, np.inf)
    early_index = np.cumsum(~one.known) - 1
    is_odd = early_index * PIECES // (early_index[-1] + 1) % 2 == 1
    for judged in (~one.known & is_odd, ~one.known & ~is_odd):
        fits = [
            least_squares(
                lambda x, rest=~judged: left(x)[rest], np.append(np.clip(rises, -inner_bounds, inner_bounds), 0.0),
                bounds=(-bounds, bounds),
            )
            for rises in starts
        ]  # fmt: skip
        early_um[judged] = left(min(fits, key=lambda fit: fit.cost).x)[judged]
    return early_um
