"""Prandtl-Ishlinskii models, as thresholds and weights, and their inverses.

Forward model, Rakotondrabe, Aljanaideh and Al Janaideh, eqs (1), (4):  y = Σ p_i F_{r_i}[u], with the play operator
F_r[u] = max(u − r, min(u + r, F_r[u]₋)). Inverse (Kuhnen 2003):  w = Σ g_j F_{z_j}[v] with

    z_j = Σ_{i≤j} p_i (r_j − r_i),   g_0 = 1/p_0,   g_j = −p_j / (Σ_{i≤j} p_i · Σ_{i<j} p_i).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real

MAX_PLAYS = 64
"""Largest number of plays of a model."""


@dataclass(frozen=True, eq=False)
class PlayModel:
    """Thresholds (n,) ascending from ≥ 0 and weights (n,) of a Prandtl-Ishlinskii operator."""

    thresholds: Real
    weights: Real

    def for_json(self) -> dict[str, Real]:
        """Return {"thresholds_v", "weights_um_per_v"}: the keys of the configuration, with V and µm/V."""
        return {"thresholds_v": self.thresholds, "weights_um_per_v": self.weights}

    def inverse(self) -> PlayModel:
        """Return the inverse operator, a Prandtl-Ishlinskii model too; a first threshold above 0 counts as 0.

        Raises ValueError where a partial sum of the weights is not positive: no inverse exists.
        """
        sums = np.cumsum(self.weights)
        if not np.all(sums > 0):
            first = int(np.argmax(~(sums > 0)))
            raise ValueError(
                f"weights: the sum of the first {first + 1} is {sums[first]:.6g}; allowed: every partial sum above 0, "
                "so that the model has an inverse"
            )
        before = np.concatenate([[0.0], sums[:-1]])
        moments = np.concatenate([[0.0], np.cumsum(self.weights * self.thresholds)[:-1]])
        thresholds = before * self.thresholds - moments
        thresholds[0] = 0.0
        weights = np.concatenate([[1 / sums[0]], -self.weights[1:] / (sums[1:] * sums[:-1])])
        return PlayModel(thresholds, weights)

    def remove_dead_band(self) -> PlayModel:
        """Return the model with all thresholds lowered by the first, r_0: the model without its dead band."""
        return PlayModel(self.thresholds - self.thresholds[0], self.weights)


def play_model(name: str, thresholds: npt.ArrayLike, weights: npt.ArrayLike) -> PlayModel:
    """Return a model of the given thresholds and weights.

    Raises ValueError, whose text begins with `name`, unless there are equally many thresholds and weights, 1 to
    MAX_PLAYS, all are finite, and the thresholds ascend from at least 0.
    """
    r, p = np.atleast_1d(np.asarray(thresholds, float)), np.atleast_1d(np.asarray(weights, float))
    if r.shape != p.shape or r.ndim != 1 or not 1 <= r.size <= MAX_PLAYS:
        raise ValueError(
            f"{name}: {r.size} thresholds and {p.size} weights; allowed: equal numbers, 1 to {MAX_PLAYS} of each"
        )
    if not (np.all(np.isfinite(r)) and np.all(np.isfinite(p))):
        raise ValueError(f"{name}: thresholds or weights are not finite; allowed: finite numbers")
    if r[0] < 0 or np.any(np.diff(r) <= 0):
        raise ValueError(f"{name}: thresholds {r.tolist()}; allowed: ascending numbers, 0 or more")
    return PlayModel(r, p)
