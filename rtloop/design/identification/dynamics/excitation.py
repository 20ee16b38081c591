"""External excitation of a closed loop, and the part of the plant's input that follows from it.

    u_k = Σ a_i u_k−i + Σ c_i r_k−i,     û = A⁻¹ C r          ARX by least squares, then simulated without its noise

In a closed loop the input contains past noise, fed back by C(z). û is free of noise, because the reference does not
depend on it. û need not equal u: any function of the reference is an instrument without bias, and a poor one only has
more variance (Söderström & Stoica 1989, chapter 8).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve
from scipy.signal import lfilter

from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.identification.dynamics.markov import ARX_ORDER, lagged_rows
from rtloop.design.identification.dynamics.prediction_error import Excitation
from rtloop.foundation.arrays import Real

RIDGE = 1e-12
"""Regularisation, relative to the regressors' mean square: references that move little leave directions undetermined.
"""
LARGEST_Z_POLE = 0.9999


@dataclass(frozen=True)
class LoopExcitation(Excitation):
    """Input and position in a closed loop, not from rest, and the `external` signals that move it, (k, samples)."""

    external: Real


def shift_to_zero(run: LoopExcitation) -> LoopExcitation:
    """Return the recording with the initial value subtracted from every signal."""
    return replace(
        run,
        input=run.input - run.input[0],
        position_um=run.position_um - run.position_um[0],
        external=run.external - run.external[:, :1],
    )


def driven_input(run: LoopExcitation) -> Real:
    """Return û (samples,), the part of the input that follows from the external signals, without noise.

    All signals of `run` must begin at 0 (`shift_to_zero`). Raises UnsuitableData for external signals that all stand
    still.
    """
    moving = [signal for signal in run.external if np.ptp(signal) > 0]
    if not moving:
        raise UnsuitableData(
            f"{run.name}: no external excitation: the reference is constant, and noise alone does not distinguish "
            "plant and controller. Use a reference that moves (multisine, chirp or steps)"
        )
    regressors = np.vstack([lagged_rows((run.input,), ARX_ORDER), moving, lagged_rows(moving, ARX_ORDER)])
    scale = np.sqrt(np.mean(regressors**2, axis=1)) + 1e-300
    regressors /= scale[:, None]
    normal = regressors @ regressors.T
    normal[np.diag_indices_from(normal)] += RIDGE * run.input.size
    coefficients = solve(normal, regressors @ run.input, assume_a="pos") / scale
    driven = coefficients[ARX_ORDER:] @ (regressors[ARX_ORDER:] * scale[ARX_ORDER:, None])
    return np.asarray(
        lfilter([1.0], _stabilise(np.concatenate([[1.0], -coefficients[:ARX_ORDER]])), driven), dtype=float
    )


def _stabilise(polynomial: Real) -> Real:
    """Return the polynomial in z, highest power first, with all its roots inside the unit circle.

    It is unchanged if they are. Else all roots of a magnitude above LARGEST_Z_POLE are shrunk to it, at the same angle.
    """
    roots = np.roots(polynomial)
    sizes = np.abs(roots)
    if np.all(sizes < 1):
        return polynomial
    return np.asarray(
        np.poly(np.where(sizes > LARGEST_Z_POLE, roots * LARGEST_Z_POLE / sizes, roots)).real, dtype=float
    )
