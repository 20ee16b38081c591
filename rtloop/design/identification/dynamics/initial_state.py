"""Free motion at the beginning of a recording that does not begin at rest, by least squares over the modes' decay.

y = G u + H ε + Σ q_i λ_i^k + offset,     H⁻¹ Σ q_i λ_i^k ≈ H⁻¹ (y − G u − offset)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.prediction_error import Excitation
from rtloop.foundation.arrays import Real

DECAY, FEWEST_SAMPLES = 1e-3, 50
"""The modes' decay ends where the slowest one has decayed to DECAY, but not before FEWEST_SAMPLES."""
LEAST_SHARE, SIGNIFICANT_RATIO = 0.3, 30.0
"""Free motion counts if it explains this share of the squared errors in the decay, and this many times the variance of
the errors behind it with each unknown.
"""


class FreeMotion(NamedTuple):
    """Motion (samples,) in µm that no recorded input explains, and its duration in s until it is below the noise."""

    position_um: Real
    duration_s: float


def free_motion(model: Innovations, run: Excitation) -> FreeMotion | None:
    """Return the free motion at the beginning of `run`, to which `model` was fitted.

    None if it is not significant, as in a recording from rest, if the run is shorter than twice the time in which the
    modes decay, and if the model's predictor is unstable.
    """
    errors = model.errors(run.input, run.position_um)
    samples = _decay_samples(model)
    if errors is None or errors.size < 2 * samples:
        return None
    modes = model.z_poles ** np.arange(errors.size)[:, None]
    columns = np.hstack([modes.real, modes.imag[:, model.rates.imag != 0]])
    whitened = model.whiten(columns.T, model.predictor_poles()).T[:samples]
    weights, *_ = np.linalg.lstsq(whitened, errors[:samples], rcond=1e-10)
    before, variance = float(np.sum(errors[:samples] ** 2)), float(np.var(errors[samples:]))
    explained = before - float(np.sum((errors[:samples] - whitened @ weights) ** 2))
    if explained < max(LEAST_SHARE * before, SIGNIFICANT_RATIO * weights.size * variance):
        return None
    position_um = columns @ weights
    audible = np.flatnonzero(np.abs(position_um) > np.sqrt(variance))
    return FreeMotion(position_um, float(audible[-1] + 1) * run.period_s if audible.size else 0.0)


def _decay_samples(model: Innovations) -> int:
    """Return the number of samples in which the slowest mode decays to DECAY, at least FEWEST_SAMPLES."""
    slowest_per_s = max(float(-model.rates.real.max()), 1e-9)
    return max(int(-np.log(DECAY) / (slowest_per_s * model.period_s)), FEWEST_SAMPLES)
