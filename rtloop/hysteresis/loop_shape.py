"""Height and width of a hysteresis loop; h/H is the paper's measure of hysteresis."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.hysteresis.plays import turning_points

BINS = 1000
"""Bins of the drive's range in which each branch is averaged."""


class LoopShape(NamedTuple):
    """Hysteresis loop, in the output's unit: largest distance h (`height`) between the branches at equal drive, NaN
    without a loop, and range H (`width`) of the output.
    """

    height: float
    width: float

    @property
    def percent(self) -> float:
        """Relative loop height 100·`height`/`width`, the paper's h/H in %; NaN without a loop."""
        return 100 * self.height / self.width


def loop_shape(drive: Real, output: Real) -> LoopShape:
    """Return the shape of the last whole loop in `drive` and `output`, each (samples,).

    Both branches are averaged in bins of the drive to reduce the effect of noise. If fewer than two branches cover 98 %
    of the drive's range, the last two branches count. With fewer than two turning points, `height` is NaN and `width`
    the range of the whole output.
    """
    span = float(np.ptp(drive))
    turns = turning_points(drive, 0.5 * span)
    if turns.size < 2:
        return LoopShape(np.nan, float(np.ptp(output)))
    ends = [*turns.tolist(), drive.size - 1]
    branches = [slice(start, end + 1) for start, end in pairwise(ends)]
    whole_branches = [part for part in branches if np.ptp(drive[part]) > 0.98 * span]
    last = whole_branches[-2:] if len(whole_branches) >= 2 else branches[-2:]
    edges = np.linspace(drive.min(), drive.max(), BINS + 1)
    first, second = (_branch_output(drive[part], output[part], edges) for part in last)
    whole_loop = output[last[0].start : last[-1].stop]
    return LoopShape(float(np.abs(first - second)[1:-1].max()), float(np.ptp(whole_loop)))


def _branch_output(drive: Real, output: Real, edges: Real) -> Real:
    """Return the output at `edges` (BINS + 1,), rising, linearly interpolated between the means of the bins with
    samples.

    Exact for a straight branch, but constant beyond the first and the last mean, thus wrong at the outer edges.
    """
    bins = np.clip(np.digitize(drive, edges) - 1, 0, BINS - 1)
    counts = np.bincount(bins, minlength=BINS)
    filled = counts > 0
    means, drives = (np.bincount(bins, values, BINS)[filled] / counts[filled] for values in (output, drive))
    return np.interp(edges, drives, means)
