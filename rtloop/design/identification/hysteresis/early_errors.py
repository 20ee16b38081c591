"""Errors of a model where a recording's memory is unknown, with the memory that fits this part best.

    F_i,k = min(max(u_0 + Σ_{j≤i} d_j, low_ik), high_ik),     |d_j| ≤ r_j − r_{j−1}

low and high are the plays that began at u_0 − r and at u_0 + r (successive clips are one clip), d the rises of the
memory curve. The rises are fitted on every second piece and judged on the pieces between. This memory has so much
freedom that the error says little about the slopes, which are therefore not fitted here.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from rtloop.design.identification.hysteresis.averaged_recording import AveragedRecording, play_block_means
from rtloop.design.identification.hysteresis.cross_validation import PIECES
from rtloop.design.identification.hysteresis.least_squares import Equations, SharedGains, model_errors
from rtloop.foundation.arrays import Real
from rtloop.hysteresis.unknown_memory import periodic_memory

INSIDE_SHARE = 0.999
"""Fraction of its bounds within which a rise begins its fit."""


def early_errors(
    run: AveragedRecording, recording_equations: Equations, common: SharedGains, own_gains: Real, thresholds: Real
) -> Real:
    """Return errors in µm, measured minus modelled, (blocks,) where memory, the state of the plays, is unknown, with
    the best-fitting memory; each is held out of the fit of this memory.

    NaN elsewhere, and everywhere if memory is known in all blocks or in none. `own_gains` are the offsets and drift of
    this recording.
    """
    early_um = np.full(recording_equations.is_known.size, np.nan)
    if recording_equations.is_known.all() or not recording_equations.is_known.any():
        return early_um
    first_v, gaps = float(run.full_v[0]), np.maximum(np.diff(thresholds, prepend=0.0), 1e-9)
    low, high = (play_block_means(run, thresholds, first_v + side * thresholds) for side in (-1.0, 1.0))
    weights = np.diff(common.slopes, prepend=0.0)
    position = model_errors(recording_equations, common, own_gains) + recording_equations.slopes @ common.slopes

    def residual(unknown: Real) -> Real:
        """Return the errors in µm of all blocks (blocks,), for `unknown`: the rises d (plays,) in V, then an offset in
        µm.
        """
        return position - unknown[-1] - np.clip(first_v + np.cumsum(unknown[:-1]), low, high) @ weights

    settled_rises = np.diff(periodic_memory(run.full_v, thresholds), prepend=first_v)
    starts = [settled_rises, np.zeros(gaps.size), 0.5 * gaps, -0.5 * gaps]
    inner_bounds, bounds = INSIDE_SHARE * gaps, np.append(gaps, np.inf)
    early_index = np.cumsum(~recording_equations.is_known) - 1
    is_odd = early_index * PIECES // (early_index[-1] + 1) % 2 == 1
    for judged_blocks in (~recording_equations.is_known & is_odd, ~recording_equations.is_known & ~is_odd):
        fits = [
            least_squares(
                lambda x, fit_mask=~judged_blocks: residual(x)[fit_mask],
                np.append(np.clip(rises, -inner_bounds, inner_bounds), 0.0),
                bounds=(-bounds, bounds),
            )
            for rises in starts
        ]  # fmt: skip
        early_um[judged_blocks] = residual(min(fits, key=lambda fit: fit.cost).x)[judged_blocks]
    return early_um
