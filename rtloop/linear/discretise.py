"""Discretisation of a controller C(s) to C(z), as a real state space:

    v_k = c·x_k + d e_k
    x_k+1 = A x_k + b e_k

Each method works on factors or modes, never on expanded polynomials. The methods differ notably: at 10 kHz, Tustin's
rule without prewarping moves a notch from 595.5 Hz, the resonance, to 588.7 Hz.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Complex, Real
from rtloop.linear.antiwindup import antiwindup, steady_state_gain
from rtloop.linear.holds import first_order_hold, hold_matrices
from rtloop.linear.realisation import (
    Form,
    System,
    cascade,
    imaginary_axis_points,
    modal_realisation,
    realise,
    row_bands,
    scale_states,
    unit_circle_points,
    well_conditioned_sum,
)
from rtloop.linear.transfer import Transfer
from rtloop.linear.zeros import zeros_and_gain

Method = Literal["matched", "tustin", "foh", "zoh"]
MAX_EXPONENT = 36.0
"""Largest exponent of a pole's or zero's image: exp(36) is 4e15, to which adding 1 is lost in rounding."""


@dataclass(frozen=True, eq=False)
class DiscreteTransfer:
    """A transfer function in z at one rate: `zeros` (m,), `poles` (n,), `gain`, and its realisation `system`.

    `form` says whether `system` is "modal" (block-diagonal) or a "cascade" (upper quasi-triangular).
    """

    zeros: Complex
    poles: Complex
    gain: float
    system: System
    form: Form


@dataclass(frozen=True, eq=False)
class DiscreteController:
    """The running controller x⁺ = A x + b e, v = c·x + d e, with its anti-windup and steady state.

    `a` (n, n) upper quasi-triangular, block-diagonal if `form` is "modal"; `b` and `c` (n,). `antiwindup` (n,) is m of
    x ← x + m (v_applied − v); `steady_state_gain` (n,) the final states for a constant input of 1. `zeros` (m,),
    `poles` (n,) and `gain` are of C(z).
    """

    method: Method
    period_s: float
    prewarp_hz: float | None
    zeros: Complex
    poles: Complex
    gain: float
    form: Form
    a: Real
    b: Real
    c: Real
    d: float
    antiwindup: Real
    steady_state_gain: Real

    @property
    def order(self) -> int:
        """Number of states of the controller."""
        return self.b.size

    @property
    def system(self) -> System:
        """State space of the controller."""
        return System(self.a, self.b, self.c, self.d)

    @property
    def row_bands(self) -> npt.NDArray[np.int64]:
        """First and past-the-last nonzero column of each row of A, shape (n, 2); (0, 0) for a row of zeros."""
        return row_bands(self.a)

    @property
    def dc_gain(self) -> float:
        """C(z = 1); +inf with an integrator, whatever the sign."""
        return math.inf if np.any(self.poles == 1) else float(self.c @ self.steady_state_gain + self.d)

    def response(self, hz: npt.ArrayLike) -> Complex:
        """Return C(exp(2πj f T)) at frequencies f (k,) in Hz, computed from the running matrices.

        Raises LinAlgError at an eigenvalue of A, as at 0 Hz with an integrator.
        """
        return self.system.response(np.exp(2j * np.pi * np.atleast_1d(np.asarray(hz, float)) * self.period_s))


def discretise_controller(
    transfer: Transfer, period_s: float, method: Method = "matched", prewarp_hz: float | None = None
) -> DiscreteController:
    """Discretise a controller at period `period_s`; "tustin" maps `prewarp_hz`, if set, to itself.

    "matched" maps poles and zeros by z = exp(sT), zeros at infinity to z = −1, and keeps the gain at 0 Hz; "tustin" is
    the bilinear rule; "foh" is exact for an input that is linear between samples (ramp invariant), "zoh" for an input
    that is held. Raises ValueError for a bad period, method or frequency, a pole or zero that the method cannot map,
    and where no anti-windup exists.
    """
    discrete = discretise_transfer(transfer, period_s, method, prewarp_hz)
    if _is_at_zero(transfer.poles, period_s).any() and (cancelled := _is_at_zero(transfer.zeros, period_s)).any():
        raise ValueError(
            f"zeros: {transfer.zeros[cancelled][0].real:g} rad/s cancels the controller's integrator at 0 rad/s; "
            "remove both"
        )
    a, b, c, d = discrete.system
    return DiscreteController(
        method, float(period_s), prewarp_hz, discrete.zeros, discrete.poles, discrete.gain, discrete.form,
        a, b, c, d, antiwindup(discrete.system, discrete.form), steady_state_gain(discrete.system),
    )  # fmt: skip


def discretise_transfer(
    transfer: Transfer, period_s: float, method: Method = "matched", prewarp_hz: float | None = None
) -> DiscreteTransfer:
    """Discretise a transfer function, of a plant or a controller, like `discretise_controller` but without anti-windup.

    Without poles, or with gain 0, the result is static. Raises ValueError for a bad period, method or frequency, and
    for a pole or zero that the method cannot map.
    """
    _require_valid(period_s, method, prewarp_hz)
    if transfer.gain == 0 or transfer.order == 0:
        no_roots, static = np.empty(0, dtype=complex), _static_system(transfer)
        return DiscreteTransfer(no_roots, no_roots, static.d, static, "modal")
    transfer = _with_integrators(transfer, period_s)
    if method in ("zoh", "foh"):
        system, form = _exact_hold(transfer, period_s, method == "foh")
        zeros, gain = zeros_and_gain(system)
        return DiscreteTransfer(zeros, np.exp(transfer.poles * period_s), gain, system, form)
    zeros, poles, gain = (
        _map_matched(transfer, period_s) if method == "matched" else _map_tustin(transfer, period_s, prewarp_hz)
    )
    return DiscreteTransfer(zeros, poles, gain, *realise(zeros, poles, gain, unit_circle_points()))


def _is_at_zero(roots: Complex, period_s: float) -> npt.NDArray[np.bool_]:
    """Return whether the image exp(sT) of each root rounds to 1, that of a root at 0."""
    return np.abs(roots) * period_s < np.finfo(float).eps


def _with_integrators(transfer: Transfer, period_s: float) -> Transfer:
    """Return `transfer` with a pole at 0 in place of one that rounds to it, as numerical programs print integrators."""
    poles = np.where(_is_at_zero(transfer.poles, period_s), 0, transfer.poles)
    return Transfer(transfer.zeros, poles, transfer.gain)


def zero_order_hold(transfer: Transfer, period_s: float) -> System:
    """Return the state space of a plant behind a zero-order hold; its zeros, which take longest, are not computed.

    Raises ValueError for a period that is not a positive number.
    """
    _require_valid(period_s, "zoh", None)
    if transfer.gain == 0 or transfer.order == 0:
        return _static_system(transfer)
    return _exact_hold(transfer, period_s, False)[0]


def _static_system(transfer: Transfer) -> System:
    """Return a state space without states whose d is the gain of `transfer` at high frequency."""
    return System(np.empty((0, 0)), np.empty(0), np.empty(0), transfer.high_frequency_gain)


def _require_valid(period_s: float, method: str, prewarp_hz: float | None) -> None:
    """Raise ValueError for a period that is no positive finite number, an unknown method, and prewarping without
    "tustin".
    """
    if not (math.isfinite(period_s) and period_s > 0):
        raise ValueError(f"period_s: {period_s!r}; allowed: a positive number of seconds")
    if method not in get_args(Method):
        raise ValueError(f"method: {method!r}; allowed: {', '.join(get_args(Method))}")
    if prewarp_hz is not None and method != "tustin":
        raise ValueError(
            f"prewarp_hz: {prewarp_hz!r} needs method 'tustin', but method is {method!r}; use 'tustin', or remove "
            "prewarp_hz"
        )


def bilinear_factor(period_s: float, prewarp_hz: float | None) -> float:
    """Return w (rad/s) of the bilinear rule s = w (z − 1)/(z + 1): 2/T, or the w that maps `prewarp_hz` to itself.

    Raises ValueError unless `prewarp_hz` is above 0 and below half the sampling rate.
    """
    if prewarp_hz is None:
        return 2 / period_s
    if not 0 < prewarp_hz < 0.5 / period_s:
        allowed = f"allowed: between 0 and half the sampling rate, {0.5 / period_s:g} Hz"
        raise ValueError(f"prewarp_hz: {prewarp_hz!r} Hz; {allowed}")
    return 2 * math.pi * prewarp_hz / math.tan(math.pi * prewarp_hz * period_s)


def _map_matched(transfer: Transfer, period_s: float) -> tuple[Complex, Complex, float]:
    """Return zeros, poles and gain of C(z), by z = exp(sT); zeros at infinity become −1, and the gain at 0 Hz stays.

    For a root at 0, this gain counts s as (z − 1)/T. A zero to the right of MAX_EXPONENT/T becomes a factor of the
    gain, as (z − image)/(1 − image) rounds to 1. Raises ValueError for a pole to the right of MAX_EXPONENT/T.
    """
    if np.any(transfer.poles.real * period_s > MAX_EXPONENT):
        raise ValueError(
            f"poles: the largest real part is {transfer.poles.real.max():g} rad/s; allowed at a period of "
            f"{period_s:g} s: up to {MAX_EXPONENT / period_s:g} rad/s"
        )
    is_representable = transfer.zeros.real * period_s <= MAX_EXPONENT
    zeros, poles = (
        np.exp(roots * period_s).astype(complex) for roots in (transfer.zeros[is_representable], transfer.poles)
    )
    gain = complex(transfer.gain)
    for root in transfer.zeros[~is_representable]:
        gain *= -root
    for root in transfer.zeros[is_representable]:
        gain /= _matched_factor(root, period_s)
    for root in transfer.poles:
        gain *= _matched_factor(root, period_s)
    infinite = poles.size - transfer.zeros.size
    return _add_zeros_at_minus_one(zeros, infinite), poles, gain.real / 2.0**infinite


def _matched_factor(root: complex, period_s: float) -> complex:
    """Return (1 − exp(root·T))/(−root), in s, without cancellation near 0; T at 0."""
    return complex(np.expm1(root * period_s) / root) if root else period_s


def _map_tustin(transfer: Transfer, period_s: float, prewarp_hz: float | None) -> tuple[Complex, Complex, float]:
    """Return zeros, poles and gain of C(z), by the bilinear rule; zeros at infinity become −1.

    Raises ValueError like `bilinear_factor`, and for a root at s = w, the factor of the rule.
    """
    w = bilinear_factor(period_s, prewarp_hz)
    if np.any(transfer.zeros == w) or np.any(transfer.poles == w):
        raise ValueError(
            f"period_s: {period_s:g} s; the transfer function has a pole or zero at s = {w:g} rad/s, which the "
            "bilinear rule moves to infinity with this period; use another period"
        )
    gain = complex(transfer.gain)
    for i, pole in enumerate(transfer.poles):
        gain *= (w - transfer.zeros[i] if i < transfer.zeros.size else 1.0) / (w - pole)
    zeros, poles = (w + transfer.zeros) / (w - transfer.zeros), (w + transfer.poles) / (w - transfer.poles)
    return _add_zeros_at_minus_one(zeros, poles.size - zeros.size), poles, gain.real


def _add_zeros_at_minus_one(zeros: Complex, count: int) -> Complex:
    """Return `zeros` with `count` more at z = −1, half the sampling rate, the images of zeros at infinity in s."""
    return np.concatenate([zeros, np.full(count, -1.0 + 0j)]).astype(complex)


def _exact_hold(transfer: Transfer, period_s: float, ramp: bool) -> tuple[System, Form]:
    """Return the scaled state space in z and its form, "modal" or "cascade".

    The state space is exact for an input that is held or, with `ramp`, linear between samples.
    """
    points = imaginary_axis_points(np.concatenate([transfer.zeros, transfer.poles]))
    modal = well_conditioned_sum(transfer.zeros, transfer.poles, transfer.gain, points)
    if modal is not None:
        modal = first_order_hold(modal, period_s) if ramp else modal.zero_order_hold(period_s)
        system = modal_realisation(modal)
    else:
        continuous = scale_states(cascade(transfer.zeros, transfer.poles, transfer.gain), points)
        system = hold_matrices(continuous, period_s, ramp)
    return scale_states(system, unit_circle_points()), "modal" if modal else "cascade"
