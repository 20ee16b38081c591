"""Least-squares slopes of a sum of plays from stretches of recordings with known memory of the moving plays.

    x_k = Σ s_i (F_i − F_{i+1})_k + creep_k·c + own_k·o

The slopes s_i of the initial loading curve, and c, are common to all recordings. o belongs to one recording: the
offset of every stretch, which includes the plays at rest in it (`unknown_memory`), and drift. The problem is linear,
with s_i ≥ least slope as its only bounds.

Penalties pull neighbouring slopes together and drift towards 0. They matter where the data leave these open, above
all where a single stroke is explained equally well by drift and by other slopes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag
from scipy.optimize import lsq_linear

from rtloop.foundation.arrays import Real

SLOPE_PENALTY = 1e-3
"""Penalty of a difference of two slopes: µm rms of error per µm that the difference makes over the drive's range."""
DRIFT_PENALTY = 1e-2
"""Penalty of drift: µm rms of error per µm of drift over the recording."""
LEAST_PENALTY = 1e-7
"""Least penalty of every unknown, so that an unknown without effect stays 0."""


class Equations(NamedTuple):
    """Equations of one recording, averaged over blocks: columns of slopes (blocks, plays), creep (blocks, terms),
    offsets (blocks, stretches) and drift (blocks, 1), or (blocks, 0) without; position in µm (blocks,).

    A stretch is a part of the recording in which the state of all plays that move is known, and has an offset of its
    own. `is_known` (blocks,) marks the blocks within a stretch; all other blocks have the offset of the last stretch.
    """

    slopes: Real
    creep: Real
    offsets: Real
    drift: Real
    position_um: Real
    is_known: npt.NDArray[np.bool_]

    @property
    def gain_columns(self) -> Real:
        """Columns of the recording's own gains, (blocks, stretches + drift): offsets, then drift."""
        return np.hstack([self.offsets, self.drift])

    @property
    def gain_penalties(self) -> Real:
        """Penalties of the recording's own gains (gains,), in µm rms per unit."""
        return np.repeat([LEAST_PENALTY, DRIFT_PENALTY], [self.offsets.shape[1], self.drift.shape[1]])

    def select_blocks(self, mask: npt.NDArray[np.bool_]) -> Equations:
        """Return the equations of the blocks for which `mask` (blocks,) is True."""
        return Equations._make(rows[mask] for rows in self)


class SharedGains(NamedTuple):
    """Gains common to all recordings: slopes in µm/V (plays,), gains of creep (terms,)."""

    slopes: Real
    creep: Real


class Limits(NamedTuple):
    """Limits of a fit: least slope in µm/V, largest range of drive in V."""

    least_slope: float
    drive_v: float


def fit_gains(recordings: Sequence[Equations], limits: Limits) -> tuple[SharedGains, list[Real]]:
    """Fit the common gains and each recording's own gains by least squares, from the blocks with known memory.

    No slope is below `limits.least_slope`. Penalties pull neighbouring slopes together (SLOPE_PENALTY times
    `limits.drive_v`, so 0 V switches it off), drift to 0 (DRIFT_PENALTY) and each other gain to 0 (LEAST_PENALTY).
    Returns the common gains and a list with one array (stretches + drifts,) for each of `recordings`: its offsets in
    µm, then its drift in µm over its duration.
    """
    known_blocks = [recording.select_blocks(recording.is_known) for recording in recordings]
    plays, creep = known_blocks[0].slopes.shape[1], known_blocks[0].creep.shape[1]
    shared = np.vstack([np.hstack([recording.slopes, recording.creep]) for recording in known_blocks])
    columns = np.hstack(
        [shared, np.asarray(block_diag(*(recording.gain_columns for recording in known_blocks)), np.float64)]
    )
    penalties = np.concatenate(
        [np.full(plays + creep, LEAST_PENALTY), *(recording.gain_penalties for recording in known_blocks)]
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
        solution, np.cumsum([plays, creep, *(recording.gain_penalties.size for recording in known_blocks)])[:-1]
    )
    return SharedGains(gains[0], gains[1]), gains[2:]


def fit_own_gains(recording: Equations, common: SharedGains) -> Real:
    """Return a recording's own gains (stretches + drifts,): its offsets in µm, then its drift in µm over its duration.

    They are fitted to its blocks of known memory, by least squares with `gain_penalties`; the gains `common` stay.
    """
    known_blocks = recording.select_blocks(recording.is_known)
    penalty_rows = known_blocks.is_known.size**0.5 * np.diag(recording.gain_penalties)
    right_side = np.append(
        model_errors(known_blocks, common, np.zeros(recording.gain_penalties.size)),
        np.zeros(recording.gain_penalties.size),
    )
    return np.asarray(
        np.linalg.lstsq(np.vstack([known_blocks.gain_columns, penalty_rows]), right_side, rcond=None)[0], np.float64
    )


def model_errors(recording: Equations, common: SharedGains, own_gains: Real) -> Real:
    """Return measured minus modelled position in µm of all blocks, of known memory or not, (blocks,)."""
    return (
        recording.position_um
        - recording.slopes @ common.slopes
        - recording.creep @ common.creep
        - recording.gain_columns @ own_gains
    )
