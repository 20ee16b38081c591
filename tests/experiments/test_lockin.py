"""Lock-in against a second-order system whose sampled response is known from scipy, in noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from rtloop.experiments.lockin import response, tone

RATE_HZ = 10_000.0
NATURAL, DAMPING = 2 * np.pi * 600.0, 0.05
AMPLITUDE, NOISE = 2.0, 0.01
FREQUENCIES_HZ = (0.1, 0.5, 2.0, 11.3, 77.7, 300.0, 590.0, 600.0, 612.0, 900.0, 1500.0, 2000.0)
NUMERATOR, DENOMINATOR, _ = signal.cont2discrete(
    ([NATURAL**2], [1.0, 2 * DAMPING * NATURAL, NATURAL**2]), 1 / RATE_HZ, "zoh"
)


def drive_system(hz: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray, complex]:
    """Return the input and noisy output of at least two seconds, settled, and the response expected from them."""
    cycles = max(2.0, np.ceil(hz))
    ticks = round((0.2 + cycles / hz) * RATE_HZ)
    u = AMPLITUDE * np.sin(2 * np.pi * hz * np.arange(ticks) / RATE_HZ)
    x = signal.lfilter(NUMERATOR.ravel(), DENOMINATOR, u)
    x += np.random.default_rng(seed).normal(0.0, NOISE, ticks) + 3.0
    z = np.exp(2j * np.pi * hz / RATE_HZ)
    expected = np.polyval(NUMERATOR.ravel(), z) / np.polyval(DENOMINATOR, z)
    settled = round(0.2 * RATE_HZ)
    return u[settled:], x[settled:], complex(expected)


@pytest.mark.parametrize("hz", FREQUENCIES_HZ)
def test_a_known_response_is_found(hz: float) -> None:
    u, x, expected = drive_system(hz)
    result = response(u, x, hz, RATE_HZ)
    assert abs(20 * np.log10(abs(result.gain / expected))) < 0.1
    assert abs(np.degrees(np.angle(result.gain / expected))) < 1.0
    assert 0.99 < result.coherence <= 1.0


def test_coherence_is_low_where_nothing_is_excited() -> None:
    u, x, _ = drive_system(100.0)
    for hz in (30.0, 130.0, 1000.0):
        assert response(u, x, hz, RATE_HZ).coherence < 0.01
    noise = np.random.default_rng(2).normal(size=u.size)
    assert response(u, noise, 100.0, RATE_HZ).coherence < 0.01


def test_harmonics_lower_the_coherence_and_nothing_else() -> None:
    k = np.arange(10_000)
    base = np.cos(2 * np.pi * 5 * k / RATE_HZ + 0.3)
    result = response(base, 2.0 * base + np.sin(2 * np.pi * 15 * k / RATE_HZ), 5.0, RATE_HZ)
    assert result.gain == pytest.approx(2.0, abs=1e-9)
    assert result.coherence == pytest.approx(0.8, abs=1e-6)  # of the powers 2 and 1/2


def test_amplitude_and_phase_refer_to_the_first_sample() -> None:
    k = np.arange(3000)
    result = tone(4.0 * np.cos(2 * np.pi * 10.1 * k / RATE_HZ + 1.0) - 7.0, 10.1, RATE_HZ)
    assert abs(result.amplitude) == pytest.approx(4.0, rel=1e-6)
    assert np.angle(result.amplitude) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("hz", "message"), [(0.0, "allowed: between 0 and"), (5000.0, "half the rate"), (0.5, "cycles")]
)
def test_a_tone_that_cannot_be_measured_is_refused(hz: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tone(np.ones(1000), hz, RATE_HZ)
