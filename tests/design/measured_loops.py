"""Simulated closed loops, by scipy alone: a lightly damped mode, hold and delay, an integrator, noise, a nonlinearity.

D(z) = (1 − z⁻¹) Z{ω²/(s² + 2ζωs + ω²)/s} z⁻ᵈ,    C(z) = k_p + k_i T/(z − 1)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import signal

from tests.design.coloured_loops import PERIOD_S, plant_polynomials, poly_sum

RATE_HZ = 1 / PERIOD_S


@dataclass(frozen=True)
class TrueLoop:
    """Mode, delay beyond the hold's sample, controller gains and rms sensor noise of a simulated loop."""

    hz: float
    damping: float
    delay_ticks: int
    ki_per_s: float
    kp: float = 0.0
    noise_um: float = 0.010

    @property
    def polynomials(self) -> tuple[np.ndarray, np.ndarray]:
        """Numerator and denominator of L in 1/z, padded to equal length."""
        b, a = plant_polynomials(((self.hz, self.damping, 1.0),), self.delay_ticks)
        numerator = np.convolve(b, [self.kp, self.ki_per_s / RATE_HZ - self.kp])
        denominator = np.convolve(a, [1.0, -1.0])
        return poly_sum(numerator, 0 * denominator), poly_sum(denominator, 0 * numerator)

    def open(self, hz: np.ndarray) -> np.ndarray:
        """Return the open loop's complex response L at the frequencies `hz`."""
        numerator, denominator = self.polynomials
        z_inverse = np.exp(-2j * np.pi * hz / RATE_HZ)
        return np.polyval(numerator[::-1], z_inverse) / np.polyval(denominator[::-1], z_inverse)

    def margins(self, from_hz: float = 1.0, to_hz: float = 0.45 * RATE_HZ) -> dict[str, float]:
        """Return the margins of L by `compute_margins`, on its grid of a million frequencies."""
        return compute_margins(self.open, from_hz, to_hz)

    def run(
        self,
        reference: np.ndarray,
        seed: int = 0,
        actuator: Callable[[float], float] | None = None,
        bypass_um: np.ndarray | None = None,
    ) -> dict[str, np.ndarray]:
        """Return the recorded signals (µm); `actuator` maps v to the input of the plant, `bypass_um` is added to v.

        Without `actuator` and `bypass_um` the loop is linear and is computed by filters instead of sample by sample.
        """
        if actuator is None and bypass_um is None:
            return self._linear(reference, seed)
        actuator, bypass_um = actuator or (lambda v: v), np.zeros(reference.size) if bypass_um is None else bypass_um
        b, a = plant_polynomials(((self.hz, self.damping, 1.0),), 0)
        b1, b2 = b[1:]
        noise = np.random.default_rng(seed).normal(0, self.noise_um, reference.size)
        e, v, x, y = np.zeros((4, reference.size))
        integral, u = 0.0, np.zeros(reference.size + self.delay_ticks + 2)
        for k in range(reference.size):
            y[k] = b1 * u[k + 1] + b2 * u[k] - a[1] * y[k - 1] - a[2] * y[k - 2] if k > 1 else 0.0
            x[k] = y[k] + noise[k]
            e[k] = reference[k] - x[k]
            v[k] = self.kp * e[k] + integral + bypass_um[k]
            integral += self.ki_per_s / RATE_HZ * e[k]
            u[k + 2 + self.delay_ticks] = actuator(v[k])
        return {"reference_um": reference, "error_um": e, "command_um": v, "position_um": x, "true_um": y}

    def _linear(self, reference: np.ndarray, seed: int) -> dict[str, np.ndarray]:
        """Return the recorded signals (µm) of the linear loop, by its transfer functions."""
        numerator, denominator = self.polynomials
        characteristic = numerator + denominator
        assert np.all(np.abs(np.roots(characteristic)) < 1), "the loop of the test must be stable"
        noise = np.random.default_rng(seed).normal(0, self.noise_um, reference.size)
        true = signal.lfilter(numerator, characteristic, reference - noise)
        e = reference - true - noise
        v = signal.lfilter([self.kp, self.ki_per_s / RATE_HZ - self.kp], [1.0, -1.0], e)
        return {"reference_um": reference, "error_um": e, "command_um": v, "position_um": true + noise, "true_um": true}


def compute_margins(
    open_loop: Callable[[np.ndarray], np.ndarray], from_hz: float = 1.0, to_hz: float = 4500.0
) -> dict[str, float]:
    """Return gain margin (ratio), phase margin (degrees) and modulus margin of L, by their definitions."""
    hz = np.geomspace(from_hz, to_hz, 1_000_000)
    loop = open_loop(hz)
    real_values = loop.real[:-1][np.diff(np.signbit(loop.imag))]
    at_unity = loop[:-1][np.diff(np.signbit(np.abs(loop) - 1))]
    return {
        "gain_margin": float(min((-1 / value for value in real_values if -1 < value < 0), default=np.inf)),
        "phase_margin_deg": float(min((180 - abs(np.degrees(np.angle(value))) for value in at_unity), default=np.inf)),
        "modulus_margin": float(np.abs(1 + loop).min()),
    }
