"""The output of the inverse compensation, y = P[P̂⁻¹[v]]: again a Prandtl-Ishlinskii operator, eqs (1)-(3) of the paper.

A sum of plays is known by its initial loading curve φ, and where the inner operator's curve increases, the loading
curve of a composition is the composition of the loading curves (Brokate & Sprekels, Hysteresis and Phase Transitions,
1996, section 2.9; Krejčí & Kuhnen, IEE Proc. Control Theory 148, 2001). Both curves here are piecewise linear, so is

    ψ(v) = φ_P(φ_P̂⁻¹(v)),     P∘P̂⁻¹[v] = Σ w_k F_ζk[v],     ζ: where ψ bends,   w: by how much its slope changes,

exactly. Eq (2) splits it into ρ v + Ω(v). While |v| ≤ V ever since rest, Ω = −∫_0^V (ψ′(r) − ρ) λ′(r) dr with the
memory curve λ(r) = F_r[v], |λ′| ≤ 1, whence

    |Ω| ≤ ξ(ρ) = ∫_0^V |ψ′(r) − ρ| dr,

and as every such λ can be reached, no smaller bound holds. Eq (3), |∫ r p_η(r) dr|, leaves the signs of the density
inside the integral: it equals ξ where all of p_η has one sign, and is no bound otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import loading_curve, loading_slopes, model_output

SAME_BEND = 1e-9
"""Bends closer together than this fraction of the largest command are merged."""


@dataclass(frozen=True)
class Residual:
    """Output y = P[P̂⁻¹[v]] = ρ v + Ω of the inverse compensation for |v| ≤ `command_um`; Ω is the residual.

    `operator` is P∘P̂⁻¹, with thresholds in µm and weights in µm/µm, those within reach. `gain` is ρ as in eq (2), the
    sum of the weights within reach; `best_gain` the ρ of the least ξ, the bound of |Ω|.
    """

    operator: PlayModel
    command_um: float
    gain: float
    best_gain: float

    def bound_um(self, gain: float) -> float:
        """Return ξ in µm, the least upper bound of |Ω| = |y − `gain`·v| for |v| ≤ `command_um` ever since rest."""
        return float(np.abs(loading_slopes(self.operator) - gain) @ self._lengths)

    @property
    def printed_bound_um(self) -> float:
        """The right side of eq (3) in µm, |Σ ζ w| over thresholds ζ and weights w of `operator`.

        It bounds the residual |Ω| for ρ = `gain`, but only where all weights after the first have one sign.
        """
        return float(abs(self.operator.thresholds @ self.operator.weights))

    @property
    def safe_bound_um(self) -> float:
        """Bound of the residual |Ω| in µm for ρ = `gain`, always valid, but loose: Σ ζ |w|, by the triangle inequality,
        over thresholds ζ and weights w of `operator`.
        """
        return float(self.operator.thresholds @ np.abs(self.operator.weights))

    def worst_commands_um(self, gain: float) -> Real:
        """Return turning points of v in µm, from rest, at the last of which |y − `gain`·v| reaches `bound_um(gain)`.

        λ′ = −sign(ψ′ − ρ): from large r to small, each run of one sign is the memory of one turning point of v."""
        signs = np.where(loading_slopes(self.operator) > gain, -1.0, 1.0)
        edges = np.append(self.operator.thresholds, self.command_um)
        turns: list[float] = []
        memory = 0.0
        for i in range(signs.size - 1, -1, -1):
            if i == signs.size - 1 or signs[i] != signs[i + 1]:
                turns.append(memory - signs[i] * edges[i + 1])
            memory -= signs[i] * (edges[i + 1] - edges[i])
        return np.array(turns)

    @property
    def _lengths(self) -> Real:
        """Widths in µm of the intervals between thresholds, the last one up to `command_um`."""
        return np.diff(self.operator.thresholds, append=self.command_um)


def residual_operator(actuator: PlayModel, inverse: PlayModel, command_um: float) -> Residual:
    """Return P∘P̂⁻¹ of the actuator's model P and the compensator `inverse`, for commands up to `command_um` µm.

    Raises ValueError if the compensator's loading curve does not increase from a first threshold of 0, and if
    `command_um` is not finite and above 0."""
    slopes = loading_slopes(inverse)
    if inverse.thresholds[0] != 0 or not np.all(slopes > 0):
        raise ValueError(
            f"compensator: the first threshold is {inverse.thresholds[0]:g} µm, and the loading curve has the slopes "
            f"{np.array2string(slopes, precision=4)}; allowed: a first threshold of 0 µm, and slopes above 0"
        )
    if not (np.isfinite(command_um) and command_um > 0):
        raise ValueError(f"command_um: {command_um} µm; allowed: a finite number above 0")
    bends = np.concatenate([inverse.thresholds, _inverse_loading_curve(inverse, actuator.thresholds)])
    thresholds = _distinct_values(bends[bends < command_um], command_um)
    middles = 0.5 * (thresholds + np.append(thresholds[1:], command_um))
    drives = loading_curve(inverse, middles)
    steepness = _loading_slope(actuator, drives) * _loading_slope(inverse, middles)
    operator = PlayModel(thresholds, np.diff(steepness, prepend=0.0))
    lengths = np.diff(thresholds, append=command_um)
    return Residual(operator, command_um, float(steepness[-1]), _weighted_median(steepness, lengths))


def compensated_output(actuator: PlayModel, inverse: PlayModel, commands_um: npt.ArrayLike) -> Real:
    """Return the output y (samples,) in µm of the actuator that the inverse drives, for commands v (samples,) in µm.

    Both models are simulated from rest, without limits.
    """
    return model_output(actuator, model_output(inverse, commands_um))


def _inverse_loading_curve(inverse: PlayModel, drives: Real) -> Real:
    """Return the commands (k,) in µm at which the increasing loading curve of `inverse` reaches the drives (k,) in V.

    Drives beyond its last threshold lie on its last straight part, extended.
    """
    levels = loading_curve(inverse, inverse.thresholds)
    part = np.clip(np.searchsorted(levels, drives, side="right") - 1, 0, None)
    return inverse.thresholds[part] + (drives - levels[part]) / loading_slopes(inverse)[part]


def _loading_slope(model: PlayModel, points: Real) -> Real:
    """Return the slope dφ/du of the initial loading curve at each of `points` ≥ 0; 0 before the first threshold.

    At a threshold it is the slope beyond.
    """
    slopes = np.concatenate([[0.0], loading_slopes(model)])
    return slopes[np.searchsorted(model.thresholds, points, side="right")]


def _distinct_values(values: Real, largest: float) -> Real:
    """Return the sorted values without those closer than SAME_BEND · `largest` to their predecessor."""
    ordered = np.sort(values)
    return ordered[np.concatenate([[True], np.diff(ordered) > SAME_BEND * largest])]


def _weighted_median(values: Real, weights: Real) -> float:
    """Return the least of the `values` ρ at which Σ weights·|values − ρ| is least."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(reached, 0.5 * reached[-1])])
