"""A first guess of modes from recorded input and output: ARX, its impulse response, and the response's modes.

    y_k = Σ a_i y_k−i + Σ b_i u_k−i + constant,     i = 1 … long            least squares
    H = (g_i+j), balanced by its singular values                            Ho & Kalman 1966, Kung 1978 (ERA)

A long ARX model is unbiased under any noise (Ljung, System Identification, 1999, section 10.4), and ERA finds the
few modes that its impulse response is made of.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import hankel
from scipy.signal import lfilter

from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.foundation.arrays import Complex, Real

ARX_ORDER = 40
"""Number of lags of the long ARX model."""
HANKEL_ROWS = 150
"""Largest number of rows of the Hankel matrix."""
CLEAR_FALL, LIKELY_FALL = 8.0, 3.0
"""Noise makes singular values that fall slowly; one that is so many times the next marks a mode, or most likely one."""
SMALLEST_Z_POLE = 1e-3
"""Poles in z nearer to 0 are a delay, which has no rate."""


def impulse_response(u: Real, y: Real, length: int, order: int = ARX_ORDER) -> Real:
    """Return g_1 … g_length (length,) of y = Σ g_i u_k−i, by least squares of an ARX model of order `order`, from
    rest.
    """
    columns = np.vstack([lagged_rows((y, u), order), np.ones(y.size)]).T
    solution, *_ = np.linalg.lstsq(columns, y, rcond=1e-12)
    pulse = np.zeros(length + 1)
    pulse[0] = 1.0
    return np.asarray(lfilter([0.0, *solution[order:-1]], [1.0, *-solution[:order]], pulse), dtype=float)[1:]


def lagged_rows(signals: Sequence[Real], most_lags: int) -> Real:
    """Return each signal 1 … `most_lags` samples late, (signals · most_lags, samples), all lags of the first signal
    first.

    Signals are 0 before their first sample.
    """
    return np.array([np.concatenate([np.zeros(i), signal[:-i]]) for signal in signals for i in range(1, most_lags + 1)])


class ModeGuesses:
    """Models of any order from one impulse response `g` (k,).

    Its Hankel matrix has as many rows as `g` allows, up to HANKEL_ROWS; `singular_values` fall.
    """

    def __init__(self, g: Real, period_s: float) -> None:
        """Decompose the Hankel matrix of the impulse response `g` (k,), whose samples are `period_s` apart."""
        self._period_s = period_s
        rows = min(HANKEL_ROWS, (g.size - 1) // 2)
        self._matrix = hankel(g[: rows + 1], g[rows : 2 * rows])
        self._left_vectors, self.singular_values, _ = np.linalg.svd(self._matrix[:-1])

    def order_at_gap(self, most_poles: int, least_fall: float) -> int:
        """Return the largest order, at most `most_poles`, behind which the singular values fall by more than
        the factor `least_fall`; 0 if none does.
        """
        values = self.singular_values[: most_poles + 1]
        falls = np.flatnonzero(values[:-1] > least_fall * values[1:])
        return int(falls[-1]) + 1 if falls.size else 0

    def initial_model(self, order: int) -> Innovations | None:
        """Return a model with the rates of `order` poles, both of a pair counted, and with residues and noise gains 0.

        Poles outside the unit circle are shrunk to |z| = 0.9999, at the same angle. None if a pole is near z = 0 or
        on the negative real axis: such a pole has no continuous counterpart.
        """
        z_poles = self._z_poles(order)
        if np.any((z_poles.imag == 0) & (z_poles.real < SMALLEST_Z_POLE)) or np.any(np.abs(z_poles) < SMALLEST_Z_POLE):
            return None
        z_poles = z_poles[z_poles.imag >= 0]
        z_poles = np.where(np.abs(z_poles) >= 1, z_poles * (0.9999 / np.abs(z_poles)), z_poles)
        no_gains = np.zeros(z_poles.size, dtype=complex)
        return Innovations(self._period_s, (np.log(z_poles) / self._period_s).astype(complex), no_gains, no_gains)

    def _z_poles(self, order: int) -> Complex:
        """Return `order` poles in z: the eigenvalues of the shift along the Hankel matrix's dominant column space."""
        root = np.sqrt(self.singular_values[:order])
        observability = self._left_vectors[:, :order] * root
        return np.linalg.eigvals(np.linalg.lstsq(observability[:-1], observability[1:], rcond=None)[0]).astype(complex)


def fit_residues(model: Innovations, u: Real, y: Real) -> Innovations:
    """Return the model with the residues and offset of least squared prediction errors for input `u` and output `y`.

    Both are (samples,). Rates and noise gains stay.
    """
    rows = -model.sensitivities(u, np.zeros_like(u), noise=False)
    whitened = model.whiten(y, model.predictor_poles())
    values, solved = model.pack(noise=False), []
    i = 0
    for rate in model.rates:
        width = 2 if rate.imag != 0 else 1
        solved += range(i + width, i + 2 * width)
        i += 2 * width
    solved.append(values.size - 1)
    scale = np.sqrt((rows[solved] ** 2).mean(axis=1)) + 1e-300
    values[solved] = np.linalg.lstsq((rows[solved] / scale[:, None]).T, whitened, rcond=None)[0] / scale
    return model.unpack(values, noise=False)
