"""Slopes of a sum of plays from stretches of recordings in which the plays that move are known, by least squares.

    x_k = Σ s_i (F_i − F_{i+1})_k + creep_k·c + own_k·o

s_i are the slopes of the initial loading curve, common to all recordings, as are c; o is each recording's own: an
offset of every stretch, which holds the plays that stand still in it (`unknown_memory`), and drift. Linear, with
s_i ≥ least as the only bounds.

Slopes of neighbours are held together, and drift is held small, each as if it were a small error: that matters where
the data leave them open, above all where one stroke looks alike with drift and with other slopes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag
from scipy.optimize import lsq_linear

from rtloop.hil.modal import Real

SLOPE_PENALTY = 1e-3
"""Error in µm rms that a difference of two slopes counts as, per µm that it makes over the drive's range."""
DRIFT_PENALTY = 1e-2
"""Error in µm rms that a µm of drift over the recording counts as."""
LEAST_PENALTY = 1e-7
"""Least weight of every unknown, so that one that does nothing stays 0."""


class Equations(NamedTuple):
    """One recording, averaged over blocks: columns of the slopes (blocks, plays), of creep (blocks, terms), of the
    stretches' offsets (blocks, stretches) and of drift (blocks, 1), or (blocks, 0) without; position in µm (blocks,).

    `known` (blocks,) says where the memory is known; elsewhere the offset is that of the last stretch.
    """

    slopes: Real
    creep: Real
    offsets: Real
    drift: Real
    position_um: Real
    known: npt.NDArray[np.bool_]

    @property
    def own_columns(self) -> Real:
        """Columns of what is the recording's own."""
        return np.hstack([self.offsets, self.drift])

    @property
    def own_penalties(self) -> Real:
        """What its gains count as, in µm rms per unit."""
        return np.repeat([LEAST_PENALTY, DRIFT_PENALTY], [self.offsets.shape[1], self.drift.shape[1]])

    def select_blocks(self, kept: npt.NDArray[np.bool_]) -> Equations:
        """Of these blocks, a mask."""
        return Equations._make(rows[kept] for rows in self)


class SharedGains(NamedTuple):
    """What all recordings share: slopes in µm/V (plays,), gains of the creep (terms,)."""

    slopes: Real
    creep: Real


class Limits(NamedTuple):
    """Least slope in µm/V, and the largest range of drive in V."""

    least_slope: float
    drive_v: float


def fit_gains(recordings: Sequence[Equations], limits: Limits) -> tuple[SharedGains, list[Real]]:
    """What all share, and the gains of what is each one's own, from the blocks whose memory is known."""
    known_blocks = [recording.select_blocks(recording.known) for recording in recordings]
    plays, creep = known_blocks[0].slopes.shape[1], known_blocks[0].creep.shape[1]
    shared = np.vstack([np.hstack([recording.slopes, recording.creep]) for recording in known_blocks])
    columns = np.hstack(
        [shared, np.asarray(block_diag(*(recording.own_columns for recording in known_blocks)), np.float64)]
    )
    penalties = np.concatenate(
        [np.full(plays + creep, LEAST_PENALTY), *(recording.own_penalties for recording in known_blocks)]
    )
    neighbour_rows = np.zeros((plays - 1, penalties.size))
    neighbour_rows[:, :plays] = SLOPE_PENALTY * limits.drive_v * np.diff(np.eye(plays), axis=0)
    penalty_rows = columns.shape[0] ** 0.5 * np.vstack([neighbour_rows, np.diag(penalties)])
    position = np.concatenate([*(recording.position_um for recording in known_blocks), np.zeros(penalty_rows.shape[0])])
    lower_bounds = np.full(penalties.size, -np.inf)
    lower_bounds[:plays] = limits.least_slope
    orthogonal, triangle = np.linalg.qr(np.vstack([columns, penalty_rows]))
    solution = lsq_linear(triangle, orthogonal.T @ position, (lower_bounds, np.inf), method="bvls").x
    gains = np.split(
        solution, np.cumsum([plays, creep, *(recording.own_penalties.size for recording in known_blocks)])[:-1]
    )
    return SharedGains(gains[0], gains[1]), gains[2:]


def fit_own_gains(one: Equations, common: SharedGains) -> Real:
    """Gains of what is a recording's own, by a model that is given."""
    known_blocks = one.select_blocks(one.known)
    penalty_rows = known_blocks.known.size**0.5 * np.diag(one.own_penalties)
    right_side = np.append(
        model_errors(known_blocks, common, np.zeros(one.own_penalties.size)), np.zeros(one.own_penalties.size)
    )
    return np.asarray(
        np.linalg.lstsq(np.vstack([known_blocks.own_columns, penalty_rows]), right_side, rcond=None)[0], np.float64
    )


def model_errors(one: Equations, common: SharedGains, own: Real) -> Real:
    """Measured − model in µm (blocks,)."""
    return one.position_um - one.slopes @ common.slopes - one.creep @ common.creep - one.own_columns @ own
