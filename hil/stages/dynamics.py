"""The cantilever's vibration, x = D(s) y, and the sensor's bandwidth, as one modal system with two outputs.

    D(s) = Σ r_i / (s − p_i) + d             the true position
    D(s)·ω / (s + ω),  ω = 2π·bandwidth      the position as the sensor sees it

Both outputs share D's modes; the second has one more. Each mode is discretised exactly for an input held over a
period: a conjugate pair is one complex mode z⁺ = λz + u whose output is Re(w z), a real pole the same with Im λ = 0.

D(s) is eq (5) of the paper (named in `hysteresis`), from its printed factors: expanded polynomials would lose too many
digits. D(0) is 1.01086 in eq (5), although the paper calls D normalised, and here.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from rtloop.foundation.modal import CLUSTER_TOLERANCE, ModalSystem, RepeatedPoles, modal_sum, quadratic_roots
from rtloop.foundation.native.compiled import jit, jit_inline

MAX_MODES = 16

PAPER_GAIN = -20.7
PAPER_NUMERATOR = (
    (1.0, -1.22e5),
    (1.0, 2.99e4),
    (1.0, -2.776e4),
    (1.0, -1.07e4),
    (1.0, 1430.0),
    (1.0, 4.3e4, 3.2e9),
)
PAPER_DENOMINATOR = (
    (1.0, 925.0, 4.59e5),
    (1.0, 55.0, 1.4e7),
    (1.0, 1.54e4, 4.0e9),
    (1.0, 964.0, 3.95e9),
)
"""D(s) = PAPER_GAIN · Π numerator / Π denominator: eq (5), each factor with its highest power of s [rad/s] first."""

COEFFICIENTS = [
    ("mode_count", "u1"),  # no more than 8 bits, so that no index can be negative
    ("mode_real", "f8", (MAX_MODES,)),
    ("mode_imag", "f8", (MAX_MODES,)),
    ("pole_real", "f8", (MAX_MODES,)),  # in rad/s, for positions between ticks
    ("pole_imag", "f8", (MAX_MODES,)),
    *((f"{output}_{part}", "f8", (MAX_MODES,)) for output in ("true", "sensed") for part in ("real", "imag")),
    ("true_direct", "f8"),
    ("sensed_direct", "f8"),
]
STATE = [
    ("modes_real", "f8", (MAX_MODES,)),
    ("modes_imag", "f8", (MAX_MODES,)),
    ("true_sums_um", "f8", (4,)),
    ("sensed_sums_um", "f8", (4,)),
    ("input_um", "f8"),
]


def roots_of_factors(factors: Iterable[Sequence[float]]) -> tuple[npt.NDArray[np.complex128], float]:
    """Return the roots (n,) of a product of polynomials of degree 0 to 2, and the product's leading coefficient.

    Each of `factors` has its coefficients with the highest power first.
    """
    roots: list[complex] = []
    leading = 1.0
    for factor in factors:
        leading *= factor[0]
        monic = [number / factor[0] for number in factor[1:]]
        if len(monic) == 1:
            roots.append(-monic[0])
        elif len(monic) == 2:
            roots += quadratic_roots(*monic)
    return np.array(roots, dtype=complex), leading


def change_resonance(
    zeros: npt.NDArray[np.complex128],
    poles: npt.NDArray[np.complex128],
    gain: float,
    shift: float,
    damping_factor: float = 1.0,
) -> tuple[npt.NDArray[np.complex128], float]:
    """Return poles and gain of D with its resonance at (1 + shift) times the frequency and `damping_factor` times the
    damping ratio; D(0) stays.

    The resonance is the pole pair p, of residue r, whose mode peaks highest, |r| / |Re p|: 595.5 Hz in eq (5). D(0)
    stays because a mass at the tip moves the frequency and not the static stiffness. Raises ValueError where there is
    no pole pair and for a damping ratio of 1 or more, and RepeatedPoles where two poles coincide.
    """
    modal = modal_sum(zeros, poles, gain)
    pairs = modal.poles.imag > 0
    if not pairs.any():
        key, value = ("damping_factor", damping_factor) if shift == 0 else ("resonance_shift", shift)
        raise ValueError(
            f"{key}: {value:g}; allowed: {1 if shift == 0 else 0}, since the plant has no complex pole pair"
        )
    with np.errstate(divide="ignore"):
        peaks = np.where(pairs, np.abs(modal.residues[0] / modal.poles.real), -1.0)
    pole = modal.poles[np.argmax(peaks)]
    changed = (1 + shift) * _damped(pole, damping_factor)
    poles = np.where(modal.poles == pole, changed, modal.poles)
    return np.where(modal.poles == pole.conj(), changed.conjugate(), poles), gain * (1 + shift) ** 2


def _damped(pole: complex, factor: float) -> complex:
    """Return a pole of the same magnitude as `pole` with `factor` times its damping ratio.

    Raises ValueError if the new damping ratio is 1 or more.
    """
    if factor == 1:
        return pole
    ratio = -pole.real / abs(pole) * factor
    if abs(ratio) >= 1:
        raise ValueError(
            f"damping_factor: {factor:g} makes a damping ratio of {ratio:.4g}; allowed: damping ratios below 1"
        )
    return abs(pole) * complex(-ratio, np.sqrt(1 - ratio**2))


def add_sensor_output(modal: ModalSystem, bandwidth_hz: float | None) -> ModalSystem:
    """Return D(s) with two outputs: the true position, and the position behind a lag of `bandwidth_hz` (None: no lag).

    Raises RepeatedPoles if the lag's pole coincides with a pole of D.
    """
    if bandwidth_hz is None:
        return ModalSystem(modal.poles, np.vstack([modal.residues] * 2), np.concatenate([modal.direct] * 2))
    corner = 2 * np.pi * bandwidth_hz
    if np.any(np.abs(modal.poles + corner) <= CLUSTER_TOLERANCE * corner):
        raise RepeatedPoles(
            f"a sensor bandwidth of {bandwidth_hz:g} Hz puts the sensor's pole on the plant's pole at {-corner:.6g} "
            "rad/s, and a double pole is not supported; use a slightly different bandwidth"
        )
    lag = corner * modal.response([-corner])[0].real
    true = np.append(modal.residues[0], 0.0)
    sensed = np.append(modal.residues[0] * corner / (modal.poles + corner), lag)
    return ModalSystem(np.append(modal.poles, -corner), np.vstack([true, sensed]), np.append(modal.direct, 0.0))


def discretise(modal: ModalSystem, period_s: float) -> dict[str, object]:
    """Return the values of COEFFICIENTS by name for `modal`, a system in s, with its input held over each period.

    Its two outputs are the true and the sensed position. Raises ValueError for more than MAX_MODES modes, and where a
    coefficient overflows at this period.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        discrete = modal.zero_order_hold(period_s)
    selected = modal.poles.imag >= 0
    count = int(selected.sum())
    if count > MAX_MODES:
        raise ValueError(
            f"{count} modes (real poles and pole pairs, the sensor's pole included); allowed: at most {MAX_MODES}"
        )
    poles = discrete.poles[selected]
    residues = np.where(modal.poles[selected].imag > 0, 2.0, 1.0) * discrete.residues[:, selected]
    if not (np.isfinite(poles).all() and np.isfinite(residues).all()):
        raise ValueError(
            f"poles: too fast to compute with a period of {period_s:g} s; use slower poles or a shorter period"
        )
    padding = np.zeros(MAX_MODES - count)
    true, sensed = residues
    return {
        "mode_count": count,
        "mode_real": np.append(poles.real, padding),
        "mode_imag": np.append(poles.imag, padding),
        "pole_real": np.append(modal.poles[selected].real, padding),
        "pole_imag": np.append(modal.poles[selected].imag, padding),
        "true_real": np.append(true.real, padding),
        "true_imag": np.append(-true.imag, padding),
        "sensed_real": np.append(sensed.real, padding),
        "sensed_imag": np.append(-sensed.imag, padding),
        "true_direct": modal.direct[0],
        "sensed_direct": modal.direct[1],
    }


def settle(coefficients: np.record, state: np.record, input_um: float) -> None:
    """Set `state.input_um` to a constant `input_um`, and every mode in `state` to its steady state at this input.

    An integrator, which has no steady state, becomes 0.
    """
    poles = coefficients.mode_real + 1j * coefficients.mode_imag
    modes: npt.NDArray[np.complex128] = np.where(poles == 1, 0.0, input_um / np.where(poles == 1, 1.0, 1 - poles))
    modes[coefficients.mode_count :] = 0.0
    state.modes_real[:], state.modes_imag[:], state.input_um = modes.real, modes.imag, input_um


@jit
def observe(coefficients, state):
    """Return true and sensed position [µm] at this instant, with the input of the period that ends here.

    The modes in `state` stay; only the partial sums change. Four modes are summed at a time, as in `hysteresis`; the
    weights beyond the last mode are 0.
    """
    real, imag = state.modes_real, state.modes_imag
    t_real, t_imag, s_real, s_imag = (
        coefficients.true_real,
        coefficients.true_imag,
        coefficients.sensed_real,
        coefficients.sensed_imag,
    )
    t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    for block in range((coefficients.mode_count + 3) // 4):
        i = 4 * block
        t0 += t_real[i] * real[i] + t_imag[i] * imag[i]
        t1 += t_real[i + 1] * real[i + 1] + t_imag[i + 1] * imag[i + 1]
        t2 += t_real[i + 2] * real[i + 2] + t_imag[i + 2] * imag[i + 2]
        t3 += t_real[i + 3] * real[i + 3] + t_imag[i + 3] * imag[i + 3]
        s0 += s_real[i] * real[i] + s_imag[i] * imag[i]
        s1 += s_real[i + 1] * real[i + 1] + s_imag[i + 1] * imag[i + 1]
        s2 += s_real[i + 2] * real[i + 2] + s_imag[i + 2] * imag[i + 2]
        s3 += s_real[i + 3] * real[i + 3] + s_imag[i + 3] * imag[i + 3]
    true_sums, sensed_sums = state.true_sums_um, state.sensed_sums_um
    true_sums[0], true_sums[1], true_sums[2], true_sums[3] = t0, t1, t2, t3
    sensed_sums[0], sensed_sums[1], sensed_sums[2], sensed_sums[3] = s0, s1, s2, s3
    true_um = coefficients.true_direct * state.input_um + ((t0 + t1) + (t2 + t3))
    return true_um, coefficients.sensed_direct * state.input_um + ((s0 + s1) + (s2 + s3))


@jit
def step(coefficients, state, input_um):
    """Advance the modes in `state` by one period with the input held at `input_um` [µm], in place."""
    state.input_um = input_um
    real, imag = state.modes_real, state.modes_imag
    for block in range((coefficients.mode_count + 3) // 4):
        i = 4 * block
        real_0, imag_0 = _next_mode(coefficients, real[i], imag[i], i, input_um)
        real_1, imag_1 = _next_mode(coefficients, real[i + 1], imag[i + 1], i + 1, input_um)
        real_2, imag_2 = _next_mode(coefficients, real[i + 2], imag[i + 2], i + 2, input_um)
        real_3, imag_3 = _next_mode(coefficients, real[i + 3], imag[i + 3], i + 3, input_um)
        real[i], real[i + 1], real[i + 2], real[i + 3] = real_0, real_1, real_2, real_3
        imag[i], imag[i + 1], imag[i + 2], imag[i + 3] = imag_0, imag_1, imag_2, imag_3


@jit_inline
def _next_mode(coefficients, real, imag, i, input_um):
    """Return real and imaginary part of mode i after a period: its pole times its state, plus `input_um`."""
    pole_real, pole_imag = coefficients.mode_real[i], coefficients.mode_imag[i]
    return pole_real * real - pole_imag * imag + input_um, pole_imag * real + pole_real * imag
