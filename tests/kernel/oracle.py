"""The paper's hysteresis written in numpy from the text alone.

Play operator (under eq (1)): F[u] = max(u − r, min(u + r, F₋)). Model (eq (4)): y = Σ p_i F_{r_i}[u].
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real

# Eq (4): thresholds r_i [V] and weights p_i [µm/V].
R = np.array([0.095, 0.38, 0.84, 1.46, 2.21, 3.07, 4.01, 4.98, 5.96, 6.89, 7.76, 8.52, 9.14, 9.61, 9.9])
P = np.array([2.55, 0.57, 1.3, -1.57, 1.25, -0.054, -0.032, 0.66, 0.16, -0.77, 2.02, -1.63, -0.15, 2.99, -1.09])

# Eq (6), as printed: thresholds z_j [µm] and weights g_j [V/µm] of the inverse.
Z = (0.0, 0.72, 2.16, 4.89, 7.04, 10.58, 14.36, 18.26, 22.81, 27.34, 30.85, 35.46, 38.24, 40.24, 42.35)
G = (0.39, -0.072, -0.094, 0.12, -0.11, 0.0033, 0.002, -0.035, -0.007, 0.04, -0.082, 0.06, 0.008, -0.095, 0.024)


class Hysteresis:
    """Hysteresis Σ w_i F_{r_i}[u] with its memory, at rest at first; eq (4) by default."""

    def __init__(self, thresholds: npt.ArrayLike = R, weights: npt.ArrayLike = P) -> None:
        self.thresholds, self.weights = np.asarray(thresholds, float), np.asarray(weights, float)
        self.plays = np.zeros(self.thresholds.size)

    def step(self, value: float) -> float:
        """Return the output for the next input."""
        self.plays = np.maximum(value - self.thresholds, np.minimum(value + self.thresholds, self.plays))
        return float(self.weights @ self.plays)

    def run(self, values: npt.ArrayLike) -> Real:
        """Return the outputs (n,) for the inputs (n,) in turn."""
        return np.array([self.step(value) for value in np.asarray(values, float)])


def sine(amplitude: float, points: int = 20001, periods: float = 2.0) -> Real:
    """Return `points` samples of `periods` of a sine that begins at 0, both ends included."""
    return amplitude * np.sin(2 * np.pi * periods * np.arange(points) / (points - 1))
