"""Sobol's indices: how much of a figure's variance each uncertain key explains, alone and with all others.

The rigs follow Saltelli's design (Saltelli and others 2010), which `samples` draws: blocks of a row of A, a row of B,
and that row of A with each key of B. The first-order index is the share of the variance that a key explains alone, the
total index the share that it explains alone or together with other keys.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rtloop.campaigns.samples import block_size
from rtloop.foundation.arrays import Real

RESAMPLES = 999
"""Samples of the bootstrap over rows of the design."""


class SensitivityIndex(NamedTuple):
    """First-order and total index of a key, each with the interval of the bootstrap at 95 % confidence."""

    first: float
    first_low: float
    first_high: float
    total: float
    total_low: float
    total_high: float


def sensitivity_indices(figure: Real, keys: Sequence[str]) -> Mapping[str, SensitivityIndex]:
    """Return the indices of each key for a figure of the rigs of the design, (rigs,) in their order.

    The first 2ᵐ whole blocks count, with the largest possible m. All indices are NaN if a figure in these blocks
    is not finite, if the figures of the rows of A and B are all equal, and for less than two blocks.
    """
    from scipy.stats import sobol_indices

    count = len(figure) // block_size(len(keys))
    count = 1 << (count.bit_length() - 1) if count else 0
    blocks = figure[: count * block_size(len(keys))].reshape(count, block_size(len(keys)))
    if count < 2 or not np.all(np.isfinite(blocks)) or np.ptp(blocks[:, :2]) == 0:
        return dict.fromkeys(keys, SensitivityIndex(*6 * (float("nan"),)))
    values: Any = {"f_A": blocks[:, :1].T, "f_B": blocks[:, 1:2].T, "f_AB": blocks[:, 2:].T[:, None, :]}
    indices = sobol_indices(func=values, n=count)
    intervals = indices.bootstrap(n_resamples=RESAMPLES)
    columns = []
    for values, interval in (
        (indices.first_order, intervals.first_order),
        (indices.total_order, intervals.total_order),
    ):
        ends = interval.confidence_interval
        columns += [np.atleast_1d(np.squeeze(column)) for column in (values, ends.low, ends.high)]
    return {key: SensitivityIndex(*(float(column[i]) for column in columns)) for i, key in enumerate(keys)}
