"""Covariance of the unknowns of a model that was fitted by prediction errors.

    (ΨΨᵀ)⁻¹ σ²                          white errors                        Ljung 1999, section 9.4
    (ΨΨᵀ)⁻¹ Ψ R Ψᵀ (ΨΨᵀ)⁻¹              errors that correlate               White 1980; Newey & West 1987

R_jk = (1 − |j − k|/(m + 1)) r_|j−k| holds the autocovariance r of the errors up to a lag m, tapered as Bartlett does,
so that no variance is negative. It makes standard deviations right where the noise model lacks a colour of the noise.
It does not see an error that follows from the input, such as one of a wrong hysteresis model.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import oaconvolve

from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.prediction_error import Excitation
from rtloop.foundation.arrays import Real

LAGS_PART = 20
"""Samples of a recording per sample of the largest lag m."""


def estimate_covariance(model: Innovations, run: Excitation, errors: Real, *, white: bool) -> Real:
    """Return the covariance (unknowns, unknowns) of `model.pack(noise=True)`, from its fit to `run`.

    `errors` (samples,) are its one-step-ahead errors, taken as uncorrelated if `white`, else with their autocovariance.
    """
    rows = model.sensitivities(run.input, errors, noise=True)
    scale = np.linalg.norm(rows, axis=1)
    scale[scale == 0] = 1.0
    rows = rows / scale[:, None]
    inverse = np.linalg.pinv(rows.T, rcond=1e-12)
    coloured = inverse * np.mean(errors**2) if white else _correlated(inverse, errors)
    return (inverse @ coloured.T) / np.outer(scale, scale)


def _correlated(rows: Real, errors: Real) -> Real:
    """Return `rows` (k, samples) times the autocovariance matrix of `errors` (samples,): (k, samples).

    The autocovariance is tapered linearly: it is 0 for lags above samples/LAGS_PART.
    """
    largest_lag = errors.size // LAGS_PART
    spectrum = np.fft.rfft(errors - errors.mean(), 2 * errors.size)
    covariances = np.fft.irfft(np.abs(spectrum) ** 2)[: largest_lag + 1] / errors.size
    tapered = covariances * (1 - np.arange(largest_lag + 1) / (largest_lag + 1))
    kernel = np.concatenate([tapered[:0:-1], tapered])
    return np.asarray(oaconvolve(rows, kernel[None, :], mode="same", axes=1), dtype=float)
