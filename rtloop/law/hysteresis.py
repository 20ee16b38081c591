"""Inverse Prandtl-Ishlinskii compensation with the memory of the drive that was really applied.

Forward model, Rakotondrabe, Aljanaideh and Al Janaideh, eqs (1), (4):  y = Σ p_i F_{r_i}[u], with the play operator
F_r[u] = max(u − r, min(u + r, F_r[u]₋)). Inverse (Kuhnen 2003):  w = Σ g_j F_{z_j}[v] with

    z_j = Σ_{i≤j} p_i (r_j − r_i),   g_0 = 1/p_0,   g_j = −p_j / (Σ_{i≤j} p_i · Σ_{i<j} p_i).

Plays that follow v would lose the actuator's memory whenever the drive is limited, slewed, raw or ramped. The law
therefore keeps the forward model on the applied drive, takes v_applied = P̂[u_applied] from it and lets the inverse's
plays follow that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rtloop.hil.native.compiled import inlined, jit
from rtloop.law.layout import LANES, MAX_PLAYS

Real = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PlayModel:
    """Thresholds (n,) ascending from ≥ 0 and weights (n,) of a Prandtl-Ishlinskii operator."""

    thresholds: Real
    weights: Real

    def for_json(self) -> dict[str, Real]:
        """With the names that a configuration has for it."""
        return {"thresholds_v": self.thresholds, "weights_um_per_v": self.weights}

    def inverse(self) -> PlayModel:
        """The inverse operator, itself a Prandtl-Ishlinskii model; a first threshold above 0 is ignored.

        Raises ValueError where a partial sum of the weights is not positive: no inverse exists.
        """
        sums = np.cumsum(self.weights)
        if not np.all(sums > 0):
            first = int(np.argmax(~(sums > 0)))
            raise ValueError(
                f"weights: their sum up to number {first} is {sums[first]:.6g}; every partial sum must be above 0, "
                "or the model has no inverse"
            )
        before = np.concatenate([[0.0], sums[:-1]])
        moments = np.concatenate([[0.0], np.cumsum(self.weights * self.thresholds)[:-1]])
        thresholds = before * self.thresholds - moments
        thresholds[0] = 0.0
        weights = np.concatenate([[1 / sums[0]], -self.weights[1:] / (sums[1:] * sums[:-1])])
        return PlayModel(thresholds, weights)

    def without_dead_band(self) -> PlayModel:
        """The same model with all thresholds lowered by the first: what remains behind the dead band r_0."""
        return PlayModel(self.thresholds - self.thresholds[0], self.weights)


def play_model(name: str, thresholds: npt.ArrayLike, weights: npt.ArrayLike) -> PlayModel:
    """A checked model. Raises ValueError naming `name`, the fault and what is allowed."""
    r, p = np.atleast_1d(np.asarray(thresholds, float)), np.atleast_1d(np.asarray(weights, float))
    if r.shape != p.shape or r.ndim != 1 or not 1 <= r.size <= MAX_PLAYS:
        raise ValueError(f"{name}: {r.size} thresholds and {p.size} weights; as many of each, 1 to {MAX_PLAYS}")
    if not (np.all(np.isfinite(r)) and np.all(np.isfinite(p))):
        raise ValueError(f"{name}: thresholds and weights must be finite")
    if r[0] < 0 or np.any(np.diff(r) <= 0):
        raise ValueError(f"{name}: thresholds {r.tolist()} must be at least 0 and ascend")
    return PlayModel(r, p)


@inlined
def play(value, threshold, last):
    """Play operator of half-width `threshold` ≥ 0 after state `last`, by comparisons: NaN and −0 cannot surprise."""
    low = value - threshold
    high = value + threshold
    raised = low if low > last else last
    return high if high < raised else raised


@inlined
def four_plays(value, thresholds, last, i):
    """Plays number i … i + 3 after `value`."""
    return (
        play(value, thresholds[i], last[i]),
        play(value, thresholds[i + 1], last[i + 1]),
        play(value, thresholds[i + 2], last[i + 2]),
        play(value, thresholds[i + 3], last[i + 3]),
    )


@jit
def total(sums, first, second, third, fourth):
    """The sum of four partial sums. `sums` keeps them: stored side by side, they are one vector to the compiler."""
    sums[0], sums[1], sums[2], sums[3] = first, second, third, fourth
    return (first + second) + (third + fourth)


@jit
def plays_sum(value, thresholds, weights, plays, count, sums):
    """Σ w_i F_i[value] in four partial sums; the plays do not move.

    Plainly: s[i mod 4] += w_i F_i[value] for i = 0 … count − 1, then (s0 + s1) + (s2 + s3).
    """
    first, second, third, fourth = 0.0, 0.0, 0.0, 0.0
    for block in range(count // LANES):
        i = block * LANES
        one, two, three, four = four_plays(value, thresholds, plays, i)
        first += weights[i] * one
        second += weights[i + 1] * two
        third += weights[i + 2] * three
        fourth += weights[i + 3] * four
    return total(sums, first, second, third, fourth)


@jit
def moved_plays_sum(value, thresholds, weights, plays, count, sums):
    """The same sum, and the plays move."""
    first, second, third, fourth = 0.0, 0.0, 0.0, 0.0
    for block in range(count // LANES):
        i = block * LANES
        one, two, three, four = four_plays(value, thresholds, plays, i)
        first += weights[i] * one
        second += weights[i + 1] * two
        third += weights[i + 2] * three
        fourth += weights[i + 3] * four
        plays[i], plays[i + 1], plays[i + 2], plays[i + 3] = one, two, three, four
    return total(sums, first, second, third, fourth)


@jit
def move_plays(value, thresholds, plays, count):
    """Plays after `value`."""
    for block in range(count // LANES):
        i = block * LANES
        plays[i], plays[i + 1], plays[i + 2], plays[i + 3] = four_plays(value, thresholds, plays, i)


@jit
def inverse_drive(coefficients, state, command_um):
    """Drive in V that the inverse gives for a command in µm, dead band included; the memory does not move."""
    drive = plays_sum(
        command_um,
        coefficients.inverse_thresholds_um,
        coefficients.inverse_weights_v_per_um,
        state.inverse_plays_um,
        coefficients.play_count,
        state.sums,
    )
    if coefficients.dead_band_v > 0.0:
        threshold = coefficients.dead_band_threshold_v
        if drive > state.model_plays_v[0] + threshold:
            state.dead_band_direction = 1.0
        elif drive < state.model_plays_v[0] - threshold:
            state.dead_band_direction = -1.0
        elif state.entering != 0:  # another mode may have left the drive anywhere within the dead band
            state.dead_band_direction = (state.drive_v - state.model_plays_v[0]) / coefficients.dead_band_v
        drive += state.dead_band_direction * coefficients.dead_band_v
    return drive


@jit
def follow_drive(coefficients, state, drive_v):
    """Advance the memory by the drive applied, and return v_applied = P̂[u_applied] in µm."""
    applied_um = moved_plays_sum(
        drive_v,
        coefficients.model_thresholds_v,
        coefficients.model_weights_um_per_v,
        state.model_plays_v,
        coefficients.play_count,
        state.sums,
    )
    move_plays(applied_um, coefficients.inverse_thresholds_um, state.inverse_plays_um, coefficients.play_count)
    return applied_um
