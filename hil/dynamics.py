"""The cantilever's vibration, x = D(s) y, and the sensor's bandwidth, as one modal system with two outputs.

    D(s) = Σ r_i / (s − p_i) + d             the true position
    D(s)·ω / (s + ω),  ω = 2π·bandwidth      the position as the sensor sees it

Both outputs share D's modes; the second has one more. Each mode is discretised exactly for an input held over a
period: a conjugate pair is one complex mode z⁺ = λz + u whose output is Re(w z), a real pole the same with Im λ = 0.

D(s) is eq (5) of the paper (named in `hil.hysteresis`), from its printed factors: expanded polynomials would lose
it. D(0) is 1.01086 there, although the text calls it normalised, and stays so.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from hil.compiled import jit
from hil.linear import CLUSTER, Modal, RepeatedPoles, modal_sum

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
    ("mode_count", "i8"),
    ("mode_real", "f8", (MAX_MODES,)),
    ("mode_imag", "f8", (MAX_MODES,)),
    ("true_weights", "f8", (MAX_MODES, 2)),
    ("sensed_weights", "f8", (MAX_MODES, 2)),
    ("true_direct", "f8"),
    ("sensed_direct", "f8"),
]
STATE = [("modes", "f8", (MAX_MODES, 2)), ("input_um", "f8")]


def roots_of_factors(factors: Iterable[Sequence[float]]) -> tuple[npt.NDArray[np.complex128], float]:
    """All roots of a product of factors of degree 0 to 2 (highest power first), and the product's leading number."""
    roots: list[complex] = []
    leading = 1.0
    for factor in factors:
        leading *= factor[0]
        monic = [number / factor[0] for number in factor[1:]]
        if len(monic) == 1:
            roots.append(-monic[0])
        elif len(monic) == 2:
            roots += _quadratic_roots(*monic)
    return np.array(roots, dtype=complex), leading


def _quadratic_roots(b: float, c: float) -> list[complex]:
    """Roots of s² + b s + c, the smaller real one from the product of the two: their difference would cancel."""
    half, discriminant = -b / 2, b * b / 4 - c
    if discriminant < 0:
        imag = float(np.sqrt(-discriminant))
        return [complex(half, imag), complex(half, -imag)]
    larger = half + float(np.copysign(np.sqrt(discriminant), half))
    return [larger, c / larger if larger else 0.0]


def shift_resonance(
    zeros: npt.NDArray[np.complex128], poles: npt.NDArray[np.complex128], gain: float, shift: float
) -> tuple[npt.NDArray[np.complex128], float]:
    """Poles and gain with the resonance at (1 + shift) times its frequency, its damping ratio and D(0) unchanged.

    The resonance is the pole pair whose mode peaks highest, |r| / |Re p|: 595.5 Hz in eq (5). D(0) stays because a
    mass at the tip moves the frequency and not the static stiffness. Raises ValueError where there is no pole pair.
    """
    modal = modal_sum(zeros, poles, gain)
    pairs = modal.poles.imag > 0
    if not pairs.any():
        raise ValueError(f"resonance_shift {shift:g}: there is no complex pole pair to shift, so it must be 0")
    with np.errstate(divide="ignore"):
        peaks = np.where(pairs, np.abs(modal.residues[0] / modal.poles.real), -1.0)
    pole = modal.poles[np.argmax(peaks)]
    shifted = np.where((modal.poles == pole) | (modal.poles == pole.conj()), (1 + shift) * modal.poles, modal.poles)
    return shifted, gain * (1 + shift) ** 2


def with_sensor(modal: Modal, bandwidth_hz: float | None) -> Modal:
    """Two outputs from D's one: the true position, and that behind a first-order lag of `bandwidth_hz` (None: none).

    Raises RepeatedPoles where the lag's pole lies on one of D's.
    """
    if bandwidth_hz is None:
        return Modal(modal.poles, np.vstack([modal.residues] * 2), np.concatenate([modal.direct] * 2))
    corner = 2 * np.pi * bandwidth_hz
    if np.any(np.abs(modal.poles + corner) <= CLUSTER * corner):
        raise RepeatedPoles(f"a sensor bandwidth of {bandwidth_hz:g} Hz repeats the pole at {-corner:.6g} rad/s")
    lag = corner * modal.response([-corner])[0].real
    true = np.append(modal.residues[0], 0.0)
    sensed = np.append(modal.residues[0] * corner / (modal.poles + corner), lag)
    return Modal(np.append(modal.poles, -corner), np.vstack([true, sensed]), np.append(modal.direct, 0.0))


def discretise(modal: Modal, period_s: float) -> dict[str, object]:
    """The kernel's coefficients for a two-output system in s, exact at the sampling instants of a held input.

    Raises ValueError where there are more than MAX_MODES modes or the period makes a number overflow.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        discrete = modal.zero_order_hold(period_s)
    kept = modal.poles.imag >= 0
    count = int(kept.sum())
    if count > MAX_MODES:
        raise ValueError(f"{count} modes (real poles and pole pairs, the sensor's included); at most {MAX_MODES} fit")
    poles = discrete.poles[kept]
    residues = np.where(modal.poles[kept].imag > 0, 2.0, 1.0) * discrete.residues[:, kept]
    if not (np.isfinite(poles).all() and np.isfinite(residues).all()):
        raise ValueError(f"overflow at a period of {period_s:g} s: use slower poles or a shorter period")
    empty = np.zeros(MAX_MODES - count)
    weights = [np.column_stack([np.append(row.real, empty), np.append(-row.imag, empty)]) for row in residues]
    return {
        "mode_count": count,
        "mode_real": np.append(poles.real, empty),
        "mode_imag": np.append(poles.imag, empty),
        "true_weights": weights[0],
        "sensed_weights": weights[1],
        "true_direct": modal.direct[0],
        "sensed_direct": modal.direct[1],
    }


def settle(coefficients: np.record, state: np.record, input_um: float) -> None:
    """Put every mode where a long rest at `input_um` leaves it; an integrator, which never rests, stays at 0."""
    poles = coefficients.mode_real + 1j * coefficients.mode_imag
    modes: npt.NDArray[np.complex128] = np.where(poles == 1, 0.0, input_um / np.where(poles == 1, 1.0, 1 - poles))
    modes[coefficients.mode_count :] = 0.0
    state.modes[:, 0], state.modes[:, 1], state.input_um = modes.real, modes.imag, input_um


@jit
def observe(coefficients, state):
    """True and sensed position [µm] at this instant, the input of the period that ends here still applied."""
    true_um = coefficients.true_direct * state.input_um
    sensed_um = coefficients.sensed_direct * state.input_um
    for i in range(coefficients.mode_count):
        real, imag = state.modes[i, 0], state.modes[i, 1]
        true_um += coefficients.true_weights[i, 0] * real + coefficients.true_weights[i, 1] * imag
        sensed_um += coefficients.sensed_weights[i, 0] * real + coefficients.sensed_weights[i, 1] * imag
    return true_um, sensed_um


@jit
def step(coefficients, state, input_um):
    """One period with the input held at `input_um` [µm]."""
    state.input_um = input_um
    for i in range(coefficients.mode_count):
        real, imag = state.modes[i, 0], state.modes[i, 1]
        across, along = coefficients.mode_imag[i], coefficients.mode_real[i]
        state.modes[i, 0] = along * real - across * imag + input_um
        state.modes[i, 1] = across * real + along * imag
