"""Simulated closed loops whose noise passes through the loop, by scipy and numpy alone: lightly damped modes behind a
hold and a delay, a controller that integrates and damps the first mode, a moving reference, and coloured noise.

    D(s) = Σ gᵢ ωᵢ²/(s² + 2ζᵢωᵢs + ωᵢ²), Σ gᵢ = 1,     x = D z⁻ᵈ v + n,     v = C (r − x)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import signal

PERIOD_S = 1e-4
MOTIONS = ("multisine", "sweep", "steps")
SHORTEST, LONGEST = 50, 150
"""Shortest and longest dwell time of a step in samples: steps of unequal length leave no gaps in the spectrum."""


@dataclass(frozen=True)
class TrueLoop:
    """Modes as (Hz, ζ, share of D(0)); delay in samples beyond the hold's; C as (numerator, denominator) in 1/z."""

    modes: tuple[tuple[float, float, float], ...]
    delay_ticks: int
    controller: tuple[np.ndarray, np.ndarray]

    @property
    def plant(self) -> tuple[np.ndarray, np.ndarray]:
        """Numerator and denominator of D(z) z⁻ᵈ as polynomials in 1/z."""
        return plant_polynomials(self.modes, self.delay_ticks)

    @property
    def characteristic_polynomial(self) -> np.ndarray:
        """Denominator of the closed loop's transfer functions, a polynomial in 1/z."""
        (b, a), (q, p) = self.plant, self.controller
        return poly_sum(np.convolve(a, p), np.convolve(b, q))

    def simulate_loop(self, reference: np.ndarray, noise: np.ndarray) -> dict[str, np.ndarray]:
        """Return the signals r, v and x (µm) of the closed loop from rest, by the loop's transfer functions."""
        (b, a), (q, p), closed = self.plant, self.controller, self.characteristic_polynomial
        command = lfilter(np.convolve(q, a), closed, reference - noise)
        position = lfilter(np.convolve(b, q), closed, reference) + lfilter(np.convolve(a, p), closed, noise)
        return {"reference_um": reference, "command_um": command, "position_um": position}

    def simulate_plant(self, command: np.ndarray, noise: np.ndarray) -> dict[str, np.ndarray]:
        """Return the signals (µm) of the plant without a controller, from rest; the command is also the reference."""
        b, a = self.plant
        return {"reference_um": command, "command_um": command, "position_um": lfilter(b, a, command) + noise}


def plant_polynomials(modes: tuple[tuple[float, float, float], ...], delay_ticks: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (numerator, denominator) in 1/z: each mode behind its hold by scipy, summed over a common denominator."""
    numerator, denominator = np.zeros(1), np.ones(1)
    for hz, damping, share in modes:
        omega = 2 * np.pi * hz
        discrete: Any = signal.cont2discrete(([share * omega**2], [1, 2 * damping * omega, omega**2]), PERIOD_S, "zoh")
        b, a = discrete[0], discrete[1]
        numerator = poly_sum(np.convolve(numerator, a), np.convolve(b.ravel(), denominator))
        denominator = np.convolve(denominator, a)
    return np.concatenate([np.zeros(delay_ticks), numerator]), denominator


def lfilter(b: Any, a: Any, signal_: np.ndarray) -> np.ndarray:
    """Return the signal filtered by B/A (polynomials in 1/z) from rest."""
    return np.asarray(signal.lfilter(b, a, signal_))


def poly_sum(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the sum of two polynomials in 1/z."""
    size = max(a.size, b.size)
    return np.pad(a, (0, size - a.size)) + np.pad(b, (0, size - b.size))


def draw_loop(random: np.random.Generator) -> TrueLoop:
    """Return a stable loop: two lightly damped modes, 0 to 3 samples of delay, `damping_controller` of gain 1 to 4."""
    while True:
        hz, share = random.uniform(150, 900), random.uniform(0.05, 0.2)
        modes = (
            (hz, random.uniform(0.005, 0.02), 1 - share),
            (hz * random.uniform(1.6, 2.6), random.uniform(0.01, 0.03), share),
        )
        loop = TrueLoop(modes, int(random.integers(0, 4)), (np.ones(1), np.ones(1)))
        loop = TrueLoop(modes, loop.delay_ticks, damping_controller(loop, random.uniform(1, 4), random.uniform(10, 40)))
        if np.abs(np.roots(loop.characteristic_polynomial)).max() < np.exp(-PERIOD_S / 0.1):
            return loop


def damping_controller(loop: TrueLoop, gain: float, ki_per_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return C in 1/z: k_i T/(z − 1) plus a broad resonance that adds the real number `gain` to L at the first mode."""
    hz = loop.modes[0][0]
    omega, z_inverse = 2 * np.pi * hz, np.exp(-2j * np.pi * hz * PERIOD_S)
    b, a = loop.plant
    target = gain / (np.polyval(b[::-1], z_inverse) / np.polyval(a[::-1], z_inverse))
    denominator = np.poly(np.exp(omega * PERIOD_S * np.roots([1, 0.6, 1]))).real
    numerator_at_mode = target * np.polyval(denominator[::-1], z_inverse) / z_inverse
    slope = numerator_at_mode.imag / z_inverse.imag
    resonant = np.array([0.0, numerator_at_mode.real - slope * z_inverse.real, slope])
    integral = np.array([0.0, ki_per_s * PERIOD_S]), np.array([1.0, -1.0])
    return poly_sum(np.convolve(resonant, integral[1]), np.convolve(integral[0], denominator)), np.convolve(
        denominator, integral[1]
    )


VIBRATION, DRIFT, SENSOR_UM = 0.95, 0.3, 0.010
"""Vibration and drift as parts of the rms value (the sum of their squares is 0.99); rms of the white sensor noise."""


def noise_denominators(near_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Return two polynomials A in 1/z: 1/A makes white noise into vibration near `near_hz`, and into drift."""
    omega = 2 * np.pi * near_hz * PERIOD_S
    return np.poly(np.exp(omega * np.roots([1, 0.1, 1]))).real, np.array([1.0, -0.9995])


def coloured_noise(random: np.random.Generator, samples: int, near_hz: float, rms_um: float) -> np.ndarray:
    """Return noise (µm): vibration near `near_hz` and drift, scaled by `rms_um`, and the sensor's white noise."""
    vibration, drift = (lfilter([1.0], a, random.normal(size=samples)) for a in noise_denominators(near_hz))
    parts = VIBRATION * vibration / vibration.std() + DRIFT * drift / drift.std()
    return rms_um * parts + random.normal(0, SENSOR_UM, samples)


def reference_motion(kind: str, random: np.random.Generator, samples: int, amplitude_um: float) -> np.ndarray:
    """Return a reference (µm): a multisine of 1 s up to 3 kHz, a logarithmic sweep to 3 kHz, or steps up and down."""
    time_s = PERIOD_S * np.arange(samples)
    if kind == "multisine":
        lines = np.arange(5, 3000, 5)
        spectrum = np.zeros(5001, complex)
        spectrum[lines] = np.exp(2j * np.pi * random.random(lines.size))
        period = np.fft.irfft(spectrum, 10_000)
        return np.resize(amplitude_um * period / np.abs(period).max(), samples)
    if kind == "sweep":
        return amplitude_um * signal.chirp(time_s, 5.0, time_s[-1], 3000.0, "logarithmic", -90)
    step_count = samples // SHORTEST + 1
    levels = amplitude_um * random.choice([-1.0, 1.0], step_count)
    return np.repeat(levels, random.integers(SHORTEST, LONGEST, step_count))[:samples]
