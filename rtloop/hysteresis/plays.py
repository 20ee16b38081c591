"""Play operators over whole recordings, and the initial loading curve that stands for a sum of them.

    F_r[u]_k = max(u_k − r, min(u_k + r, F_r[u]_k−1)),     F_r = 0 before the first sample of a virgin play
    φ(u) = Σ p_i max(u − r_i, 0)                           initial loading curve, u ≥ 0

Krasnosel'skii & Pokrovskii, Systems with Hysteresis, 1989; Kuhnen, European Journal of Control 9, 2003.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.hysteresis.play_model import PlayModel


def play_outputs(drive: npt.ArrayLike, thresholds: npt.ArrayLike, initial_outputs: Real | None = None) -> Real:
    """Return the outputs F_r[u] of plays, (samples, plays), in the unit of `drive` (samples,) and of `thresholds`.

    The plays are virgin (drive and outputs were 0), or have outputs `initial_outputs` (plays,) at the first sample.

    Between two reversals of the drive, the formula holds for all samples at once with the state before the first."""
    u, r = np.asarray(drive, dtype=float), np.asarray(thresholds, dtype=float)
    u = np.concatenate([[0.0] if initial_outputs is None else u[:1], u])
    outputs = np.empty((u.size, r.size))
    last = np.zeros(r.size) if initial_outputs is None else initial_outputs
    bounds = [0, *(_reversals(u) + 1).tolist(), u.size]
    for start, end in pairwise(bounds):
        part = u[start:end, None]
        outputs[start:end] = np.maximum(part - r, np.minimum(part + r, last))
        last = outputs[end - 1]
    return outputs[1:]


def model_output(model: PlayModel, drive: npt.ArrayLike) -> Real:
    """Return the output P[u] (samples,) of a virgin model, with drive and outputs 0 before, for `drive` (samples,)."""
    return play_outputs(drive, model.thresholds) @ model.weights


def turning_points(drive: Real, min_reversal: float) -> npt.NDArray[np.intp]:
    """Return the rising indices of the drive's alternating maxima and minima, each followed by a reversal of at least
    `min_reversal`, in the drive's unit.

    The first sample is never among them.
    """
    turns: list[int] = []
    candidates = [0, *_reversals(drive).tolist(), drive.size - 1]
    low = high = 0
    for k in candidates:
        low = k if drive[k] <= drive[low] else low
        high = k if drive[k] >= drive[high] else high
        if drive[k] <= drive[high] - min_reversal:
            turns += [high] if not turns or drive[turns[-1]] < drive[high] else []
            low = high = k
        elif drive[k] >= drive[low] + min_reversal:
            turns += [low] if not turns or drive[turns[-1]] > drive[low] else []
            low = high = k
    return np.array([k for k in turns if k], dtype=np.intp)


def loading_slopes(model: PlayModel) -> Real:
    """Return the slopes dφ/du (n,) of the initial loading curve beyond each threshold r_i: Σ_{j≤i} p_j."""
    return np.cumsum(model.weights)


def loading_curve(model: PlayModel, drive: npt.ArrayLike) -> Real:
    """Return the initial loading curve φ at `drive` ≥ 0, in the shape of `drive`: outputs of a virgin model."""
    u = np.asarray(drive, dtype=float)
    return (np.maximum(u[..., None] - model.thresholds, 0.0) * model.weights).sum(axis=-1)


def _reversals(u: Real) -> npt.NDArray[np.intp]:
    """Return the indices of the samples after which the drive `u` changes direction.

    If several samples in succession are equal, the last one counts.
    """
    steps = np.flatnonzero(np.diff(u))
    directions = np.sign(np.diff(u)[steps])
    return steps[1:][directions[1:] != directions[:-1]]
