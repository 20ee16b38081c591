"""Closed loops by scipy and numpy alone, whose noise comes back through the loop: lightly damped modes behind a hold
and a delay, an integrator that damps the first of them, a reference that moves, and noise that is far from white.

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
"""Samples of a step: unequal ones leave no gaps in the spectrum."""


@dataclass(frozen=True)
class TrueLoop:
    """Modes as (Hz, ζ, share of D(0)); samples of delay beyond the hold's; C as polynomials in 1/z."""

    modes: tuple[tuple[float, float, float], ...]
    delay_ticks: int
    controller: tuple[np.ndarray, np.ndarray]

    @property
    def plant(self) -> tuple[np.ndarray, np.ndarray]:
        """D(z) z⁻ᵈ as polynomials in 1/z."""
        return plant_of(self.modes, self.delay_ticks)

    @property
    def closed(self) -> np.ndarray:
        """The loop's characteristic polynomial in 1/z."""
        (b, a), (q, p) = self.plant, self.controller
        return added(np.convolve(a, p), np.convolve(b, q))

    def in_loop(self, reference: np.ndarray, noise: np.ndarray) -> dict[str, np.ndarray]:
        """v and x, from rest, filtered by the loop's own transfer functions."""
        (b, a), (q, p) = self.plant, self.controller
        command = filtered(np.convolve(q, a), self.closed, reference - noise)
        position = filtered(np.convolve(b, q), self.closed, reference) + filtered(np.convolve(a, p), self.closed, noise)
        return {"reference_um": reference, "command_um": command, "position_um": position}

    def open(self, command: np.ndarray, noise: np.ndarray) -> dict[str, np.ndarray]:
        """The same plant without a loop."""
        b, a = self.plant
        return {"reference_um": command, "command_um": command, "position_um": filtered(b, a, command) + noise}


def plant_of(modes: tuple[tuple[float, float, float], ...], delay_ticks: int) -> tuple[np.ndarray, np.ndarray]:
    """Each mode behind its hold, by scipy; the sum over a common denominator."""
    top, bottom = np.zeros(1), np.ones(1)
    for hz, damping, share in modes:
        omega = 2 * np.pi * hz
        held: Any = signal.cont2discrete(([share * omega**2], [1, 2 * damping * omega, omega**2]), PERIOD_S, "zoh")
        b, a = held[0], held[1]
        top, bottom = added(np.convolve(top, a), np.convolve(b.ravel(), bottom)), np.convolve(bottom, a)
    return np.concatenate([np.zeros(delay_ticks), top]), bottom


def filtered(b: Any, a: Any, signal_: np.ndarray) -> np.ndarray:
    """B/A applied, from rest."""
    return np.asarray(signal.lfilter(b, a, signal_))


def added(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The sum of two polynomials in 1/z."""
    size = max(a.size, b.size)
    return np.pad(a, (0, size - a.size)) + np.pad(b, (0, size - b.size))


def drawn_loop(random: np.random.Generator) -> TrueLoop:
    """Two lightly damped modes, up to three samples of delay, |L| of 1 … 4 and a phase of 0° at the first: stable."""
    while True:
        hz, share = random.uniform(150, 900), random.uniform(0.05, 0.2)
        modes = (
            (hz, random.uniform(0.005, 0.02), 1 - share),
            (hz * random.uniform(1.6, 2.6), random.uniform(0.01, 0.03), share),
        )
        loop = TrueLoop(modes, int(random.integers(0, 4)), (np.ones(1), np.ones(1)))
        loop = TrueLoop(modes, loop.delay_ticks, damping_controller(loop, random.uniform(1, 4), random.uniform(10, 40)))
        if np.abs(np.roots(loop.closed)).max() < np.exp(-PERIOD_S / 0.1):
            return loop


def damping_controller(loop: TrueLoop, gain: float, ki_per_s: float) -> tuple[np.ndarray, np.ndarray]:
    """k_i T/(z − 1) and a broad resonance at the first mode, turned so that L there is `gain` and real."""
    hz = loop.modes[0][0]
    omega, back = 2 * np.pi * hz, np.exp(-2j * np.pi * hz * PERIOD_S)
    b, a = loop.plant
    wanted = gain / (np.polyval(b[::-1], back) / np.polyval(a[::-1], back))
    bottom = np.poly(np.exp(omega * PERIOD_S * np.roots([1, 0.6, 1]))).real
    at_mode = wanted * np.polyval(bottom[::-1], back) / back
    slope = at_mode.imag / back.imag
    resonant = np.array([0.0, at_mode.real - slope * back.real, slope])
    integral = np.array([0.0, ki_per_s * PERIOD_S]), np.array([1.0, -1.0])
    return added(np.convolve(resonant, integral[1]), np.convolve(integral[0], bottom)), np.convolve(bottom, integral[1])


SHAKEN, DRIFT, SENSOR_UM = 0.95, 0.3, 0.010
"""Parts of the rms value (their squares add up to 1), and white noise beside them."""


def colours(near_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Polynomials in 1/z behind which white noise is what shakes the plant near `near_hz`, and drift."""
    omega = 2 * np.pi * near_hz * PERIOD_S
    return np.poly(np.exp(omega * np.roots([1, 0.1, 1]))).real, np.array([1.0, -0.9995])


def coloured(random: np.random.Generator, samples: int, near_hz: float, rms_um: float) -> np.ndarray:
    """Broad noise near `near_hz`, drift, and a sensor's."""
    shaken, drift = (filtered([1.0], a, random.normal(size=samples)) for a in colours(near_hz))
    parts = SHAKEN * shaken / shaken.std() + DRIFT * drift / drift.std()
    return rms_um * parts + random.normal(0, SENSOR_UM, samples)


def motion(kind: str, random: np.random.Generator, samples: int, amplitude_um: float) -> np.ndarray:
    """A multisine of 1 s up to 3 kHz with random phases, a logarithmic sweep, or steps up and down."""
    time_s = PERIOD_S * np.arange(samples)
    if kind == "multisine":
        lines = np.arange(5, 3000, 5)
        spectrum = np.zeros(5001, complex)
        spectrum[lines] = np.exp(2j * np.pi * random.random(lines.size))
        period = np.fft.irfft(spectrum, 10_000)
        return np.resize(amplitude_um * period / np.abs(period).max(), samples)
    if kind == "sweep":
        return amplitude_um * signal.chirp(time_s, 5.0, time_s[-1], 3000.0, "logarithmic", -90)
    most = samples // SHORTEST + 1
    levels = amplitude_um * random.choice([-1.0, 1.0], most)
    return np.repeat(levels, random.integers(SHORTEST, LONGEST, most))[:samples]
