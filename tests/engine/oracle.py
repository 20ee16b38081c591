"""Linear closed loop written out from the paper's factors; it shares no code with the tested program.

C(s): eq (20)      D(s): eq (5)      e_k = r_k − x_k      v_k = C(z) e      x: D(s) on v held, `latency` ticks later
"""

from __future__ import annotations

from typing import NamedTuple

import mpmath as mp
import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real

PERIOD_S = mp.mpf(1) / 10_000

C_GAIN = mp.mpf("0.016")
C_NUMERATOR = (("1", "7.9e6"), ("1", "971", "4.6e5"), ("1", "43", "1.4e7"))
C_DENOMINATOR = (("1", "8.8e4"), ("1", "974"), ("1", "1"), ("1", "1153", "1.6e7"))
D_GAIN = mp.mpf("-20.7")
D_NUMERATOR = (
    *(("1", "-1.22e5"), ("1", "2.99e4"), ("1", "-2.776e4"), ("1", "-1.07e4"), ("1", "1430")),
    ("1", "4.3e4", "3.2e9"),
)
D_DENOMINATOR = (("1", "925", "4.59e5"), ("1", "55", "1.4e7"), ("1", "1.54e4", "4.0e9"), ("1", "964", "3.95e9"))


def roots(factors: tuple[tuple[str, ...], ...]) -> list[mp.mpc]:
    """Return all roots of factors of first and second order, by the quadratic formula in mpmath's precision."""
    values: list[mp.mpc] = []
    for factor in factors:
        numbers = [mp.mpf(number) for number in factor[1:]]
        if len(numbers) == 1:
            values.append(mp.mpc(-numbers[0]))
        else:
            half = mp.sqrt(mp.mpc(numbers[0] ** 2 - 4 * numbers[1]))
            values += [(-numbers[0] + half) / 2, (-numbers[0] - half) / 2]
    return values


class Modes(NamedTuple):
    """System x⁺ = poles·x + inputs·u, y = Re Σ x + direct·u in complex modes, with both poles of a conjugate pair."""

    poles: npt.NDArray[np.complex128]
    inputs: npt.NDArray[np.complex128]
    direct: float


def partial_fractions(zeros: list, poles: list, gain) -> tuple[list, mp.mpc]:
    """Return the residues at the poles, all simple, and the value at infinity."""
    residues = [
        gain * mp.fprod(p - z for z in zeros) / mp.fprod(p - q for j, q in enumerate(poles) if j != i)
        for i, p in enumerate(poles)
    ]
    return residues, gain if len(zeros) == len(poles) else mp.mpf(0)


def as_modes(poles: list, inputs: list, direct) -> Modes:
    """Return a system in complex doubles."""
    return Modes(np.array([complex(p) for p in poles]), np.array([complex(b) for b in inputs]), float(mp.re(direct)))


def controller(method: str) -> Modes:
    """Return C(z): "tustin" s = ω₀/tan(ω₀T/2) · (z − 1)/(z + 1), ω₀ = 2π·595.5; "matched" z = exp(sT), gain at DC."""
    with mp.workdps(60):
        zeros, poles = roots(C_NUMERATOR), roots(C_DENOMINATOR)
        if method == "matched":
            z_zeros, z_poles = [mp.exp(r * PERIOD_S) for r in zeros], [mp.exp(r * PERIOD_S) for r in poles]
            at_dc = C_GAIN * mp.fprod(-z for z in zeros) / mp.fprod(-p for p in poles)
            gain = at_dc * mp.fprod(1 - p for p in z_poles) / mp.fprod(1 - z for z in z_zeros)
        else:
            omega = 2 * mp.pi * mp.mpf("595.5")
            w = omega / mp.tan(omega * PERIOD_S / 2)
            z_zeros, z_poles = [(w + r) / (w - r) for r in zeros], [(w + r) / (w - r) for r in poles]
            gain = C_GAIN * mp.fprod(w - z for z in zeros) / mp.fprod(w - p for p in poles)
        residues, direct = partial_fractions(z_zeros, z_poles, gain)
        return as_modes(z_poles, residues, direct)


def plant() -> Modes:
    """Return D(s) = Σ r/(s − p) with its input held over each period: z = exp(pT), input r (exp(pT) − 1)/p."""
    with mp.workdps(60):
        poles = roots(D_DENOMINATOR)
        residues, direct = partial_fractions(roots(D_NUMERATOR), poles, D_GAIN)
        z_poles = [mp.exp(p * PERIOD_S) for p in poles]
        return as_modes(z_poles, [r * (z - 1) / p for r, z, p in zip(residues, z_poles, poles, strict=True)], direct)


class Response(NamedTuple):
    """Signals of the closed loop, each of shape (ticks,)."""

    position_um: Real
    command_um: Real


def closed_loop(reference: Real, method: str, latency: int = 0, limit_um: float = np.inf) -> Response:
    """Return the response from rest. `limit_um` limits the plant's input without anti-windup in the controller."""
    c, d = controller(method), plant()
    x_c, x_d = np.zeros(c.poles.size, complex), np.zeros(d.poles.size, complex)
    delayed_um = [0.0] * latency
    position, command = np.empty(reference.size), np.empty(reference.size)
    for k, reference_um in enumerate(reference):
        position[k] = x_d.sum().real
        error = reference_um - position[k]
        command[k] = x_c.sum().real + c.direct * error
        x_c = c.poles * x_c + c.inputs * error
        delayed_um.append(min(max(command[k], -limit_um), limit_um))
        x_d = d.poles * x_d + d.inputs * delayed_um.pop(0)
    return Response(position, command)
