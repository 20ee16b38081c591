"""Slopes of a sum of plays and the memory that each recording began with, both unknown, by least squares.

    x_k = Σ s_i (F_i − F_{i+1})_k + creep_k·c + own_k·o
    F_i,k = min(max(z_i, low_ik), high_ik),     z_i = u_0 + Σ_{j≤i} d_j

s_i are the slopes of the initial loading curve, common to all recordings, as are c; the rises d of the memory curve
and o (offset, drift) are each recording's own. |d_j| ≤ r_j − r_{j−1} (`unknown_memory`) and s_i ≥ least are bounds on
single unknowns, and each step is a linear problem with bounds: Gauss-Newton, where a damping of the rises alone
(Levenberg 1944) keeps them near while a play's end lies beyond the samples that know of it.

The slopes of neighbours are held together by RIDGE, which matters for those alone that the data leave open.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import lsq_linear

from rtloop.hil.modal import Real

RIDGE = 1e-3
"""Error in µm rms that a difference of two slopes counts as, per µm that it makes over the drive's range."""
DAMPING, HARDER, SOFTER, LEAST_DAMPING = 3e-3, 4.0, 0.25, 3e-7
"""Of the rises, per µm that they move the position at the mean slope: at first, after a failed step, after a good
one."""
STEPS, TRIALS, DONE = 40, 8, 1e-4
"""At most so many steps, each tried so often; the last is that which gains less than this part."""
FLOOR = 1e-7
"""Least weight of every unknown, so that one that does nothing stays where it is."""


class Stretch(NamedTuple):
    """One recording, averaged over blocks: bounds of the plays (blocks, plays), creep (blocks, terms), own terms
    (blocks, terms), position in µm (blocks,). `first_v` is where the drive began. low = high says that memory is known.
    """

    first_v: float
    low: Real
    high: Real
    creep: Real
    own: Real
    position_um: Real

    def only(self, kept: npt.NDArray[np.bool_]) -> Stretch:
        """Of these blocks, a mask."""
        return Stretch(self.first_v, *(rows[kept] for rows in self[1:]))


class Common(NamedTuple):
    """What all recordings share: slopes in µm/V (plays,), gains of the creep (terms,)."""

    slopes: Real
    creep: Real


class Own(NamedTuple):
    """What one recording has for itself: gains of its terms, rises of the memory curve in V (plays,)."""

    terms: Real
    rises: Real


class Equations(NamedTuple):
    """columns · change ≈ left, reduced from so many blocks."""

    columns: Real
    left: Real
    blocks: int


class Limits(NamedTuple):
    """Thresholds in V (plays,), least slope in µm/V, and the largest drive and position ranges, by which things are
    small."""

    thresholds_v: Real
    least_slope: float
    drive_v: float
    range_um: float


def output(stretch: Stretch, common: Common, own: Own) -> Real:
    """Position in µm (blocks,)."""
    return (
        _plays(stretch, own) @ np.diff(common.slopes, prepend=0.0)
        + stretch.creep @ common.creep
        + stretch.own @ own.terms
    )


def errors(stretch: Stretch, common: Common, own: Own) -> Real:
    """Measured − model in µm (blocks,)."""
    return stretch.position_um - output(stretch, common, own)


def fit_memory(
    stretches: Sequence[Stretch], common: Common, owns: Sequence[Own], limits: Limits, *, fixed: bool = False
) -> tuple[Common, list[Own]]:
    """The nearest best from this beginning; with `fixed` the common unknowns stay as they are."""
    found, damping = (common, list(owns)), DAMPING
    cost = _cost(stretches, *found, limits)
    for _ in range(STEPS):
        equations = _linearised(stretches, *found, limits)
        for _ in range(TRIALS):
            tried = _stepped(*found, _step(equations, *found, limits, damping, fixed), limits)
            reached = _cost(stretches, *tried, limits)
            if reached < cost:
                break
            damping *= HARDER
        else:
            return found
        gain, found, cost, damping = 1 - reached / cost, tried, reached, max(SOFTER * damping, LEAST_DAMPING)
        if gain < DONE:
            break
    return found


def _plays(stretch: Stretch, own: Own) -> Real:
    return np.clip(stretch.first_v + np.cumsum(own.rises), stretch.low, stretch.high)


def _cost(stretches: Sequence[Stretch], common: Common, owns: Sequence[Own], limits: Limits) -> float:
    squares = [np.sum(errors(stretch, common, own) ** 2) for stretch, own in zip(stretches, owns, strict=True)]
    apart = RIDGE * limits.drive_v * np.diff(common.slopes)
    return float(np.sum(squares) + _count(stretches) * np.sum(apart**2))


def _count(stretches: Sequence[Stretch]) -> int:
    return sum(stretch.position_um.size for stretch in stretches)


def _linearised(stretches: Sequence[Stretch], common: Common, owns: Sequence[Own], limits: Limits) -> Equations:
    """Columns and errors of one step, reduced recording by recording to as many rows as there are columns.

    In order: slopes, creep, then of each recording its terms and its rises. Last the ridge.
    """
    shared, private = sum(part.size for part in common), owns[0].terms.size + owns[0].rises.size
    columns, left = [], []
    for index, (stretch, own) in enumerate(zip(stretches, owns, strict=True)):
        plays = _plays(stretch, own)
        free = (stretch.low < plays) & (plays < stretch.high)
        by_rise = np.cumsum((free * np.diff(common.slopes, prepend=0.0))[:, ::-1], axis=1)[:, ::-1]
        by_slope = plays - np.append(plays[:, 1:], np.zeros((plays.shape[0], 1)), axis=1)
        parts = (by_slope, stretch.creep, stretch.own, by_rise, errors(stretch, common, own)[:, None])
        triangle = np.asarray(np.linalg.qr(np.hstack(parts), mode="r"))
        rows = np.zeros((triangle.shape[0], shared + private * len(owns)))
        rows[:, :shared] = triangle[:, :shared]
        rows[:, shared + index * private : shared + (index + 1) * private] = triangle[:, shared:-1]
        columns.append(rows)
        left.append(triangle[:, -1])
    held = np.zeros((common.slopes.size - 1, shared + private * len(owns)))
    held[:, : common.slopes.size] = np.diff(np.eye(common.slopes.size), axis=0)
    held *= RIDGE * limits.drive_v * _count(stretches) ** 0.5
    apart = held[:, : common.slopes.size] @ common.slopes
    return Equations(np.vstack([*columns, held]), np.concatenate([*left, -apart]), _count(stretches))


def _step(
    equations: Equations, common: Common, owns: Sequence[Own], limits: Limits, damping: float, fixed: bool
) -> Real:
    """Change of every unknown, within its bounds."""
    gaps = np.diff(limits.thresholds_v, prepend=0.0)
    no_terms = np.full(owns[0].terms.size, np.inf)
    creep = np.full(common.creep.size, np.inf)
    slopes = np.full(common.slopes.size, np.inf)
    low = [
        limits.least_slope - common.slopes,
        -creep,
        *(part for own in owns for part in (-no_terms, -gaps - own.rises)),
    ]
    high = [slopes, creep, *(part for own in owns for part in (no_terms, gaps - own.rises))]
    weight = [np.full(slopes.size + creep.size, FLOOR)]
    weight += [part for _ in owns for part in (np.full(no_terms.size, FLOOR), np.full(gaps.size, damping))]
    weights = np.concatenate(weight) * equations.blocks**0.5 * limits.range_um / limits.drive_v
    least, most = np.minimum(np.concatenate(low), -1e-12), np.maximum(np.concatenate(high), 1e-12)
    shared = slopes.size + creep.size if fixed else 0
    system = np.vstack([equations.columns, np.diag(weights)])[:, shared:]
    goal = np.append(equations.left, np.zeros(weights.size))
    found = lsq_linear(system, goal, (least[shared:], most[shared:]), method="bvls").x
    return np.append(np.zeros(shared), found)


def _stepped(common: Common, owns: Sequence[Own], change: Real, limits: Limits) -> tuple[Common, list[Own]]:
    gaps = np.diff(limits.thresholds_v, prepend=0.0)
    sizes = [part.size for parts in (common, *owns) for part in parts]
    steps = iter(np.split(change, np.cumsum(sizes)[:-1]))
    shared = Common(np.maximum(common.slopes + next(steps), limits.least_slope), common.creep + next(steps))
    return shared, [Own(own.terms + next(steps), np.clip(own.rises + next(steps), -gaps, gaps)) for own in owns]
