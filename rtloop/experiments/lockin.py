"""Lock-in: amplitude and phase of a signal at one frequency, and a response from two signals.

    s_k ≈ Re(S e^{2πi f kT}) + c        least squares over the samples
    G(f) = X/U,     γ² = (fraction of x at f)·(fraction of u at f),     fractions of the power about the mean

The constant is fitted along, so that a window need not hold a whole number of cycles; where it does, harmonics have
no effect. No drift is fitted: over a single cycle it would take the harmonics of a hysteresis for a slope. γ² is near
1 where a linear system is driven by one sine, and falls with noise, harmonics, and without excitation.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from rtloop.foundation.arrays import Real

MIN_CYCLES = 0.9
"""Least number of cycles; in less, sine and constant cannot be distinguished."""
BLOCK_SAMPLES = 1 << 18


class Tone(NamedTuple):
    """Complex amplitude S of the part Re(S e^{jωt}), and its fraction 0 … 1 of the signal's power about the mean."""

    amplitude: complex
    power_ratio: float


class Response(NamedTuple):
    """Complex gain at one frequency, and coherence γ²."""

    gain: complex
    coherence: float


def tone(signal: Real, hz: float, rate_hz: float) -> Tone:
    """Return the complex amplitude of the part of `signal` (samples,) at `hz`, and its fraction of the signal's power.

    The phase refers to the first sample; the power is about the mean. Raises ValueError for a frequency that is
    not between 0 and half the rate, and for fewer than MIN_CYCLES cycles or three samples.
    """
    if not 0 < hz < rate_hz / 2:
        raise ValueError(f"frequency: {hz:g} Hz; allowed: between 0 and {rate_hz / 2:g} Hz, half the rate")
    if signal.size * hz < MIN_CYCLES * rate_hz or signal.size < 3:
        raise ValueError(
            f"{signal.size} samples at {rate_hz:g} Hz cover {signal.size * hz / rate_hz:.2g} cycles of {hz:g} Hz; "
            f"allowed: at least {MIN_CYCLES} cycles, and at least 3 samples. Use a longer recording"
        )
    gram, rhs = np.zeros((3, 3)), np.zeros(3)
    for block, columns in _blocks(signal, hz / rate_hz):
        gram += columns.T @ columns
        rhs += columns.T @ block
    weights = np.linalg.solve(gram, rhs)
    residual_power = power = 0.0
    for block, columns in _blocks(signal, hz / rate_hz):
        deviation = block - weights[2]
        power += float(deviation @ deviation)
        residual = block - columns @ weights
        residual_power += float(residual @ residual)
    return Tone(complex(weights[0], -weights[1]), max(0.0, 1 - residual_power / power) if power else 0.0)


def response(u: Real, x: Real, hz: float, rate_hz: float) -> Response:
    """Return gain and coherence from input `u` to output `x`, each (samples,), at `hz`.

    The gain is NaN where `u` has no part at `hz`, such as for a constant 0.

    Raises ValueError as `tone`.
    """
    input_tone, output_tone = tone(u, hz, rate_hz), tone(x, hz, rate_hz)
    gain = output_tone.amplitude / input_tone.amplitude if input_tone.amplitude else complex(np.nan, np.nan)
    return Response(gain, input_tone.power_ratio * output_tone.power_ratio)


def _blocks(signal: Real, turns_per_sample: float) -> Iterator[tuple[Real, Real]]:
    """Yield blocks (count,) of a signal, each with cos, sin and 1 at its samples, (count, 3).

    `turns_per_sample` is the frequency of cos and sin over the rate; their phase is 0 at the signal's first sample.
    """
    for start in range(0, signal.size, BLOCK_SAMPLES):
        block = signal[start : start + BLOCK_SAMPLES]
        k = np.arange(start, start + block.size, dtype=float)
        angle = 2 * np.pi * np.remainder(k * turns_per_sample, 1.0)
        yield block, np.stack([np.cos(angle), np.sin(angle), np.ones(block.size)], axis=1)
