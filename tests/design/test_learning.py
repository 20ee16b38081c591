"""Learning of periodic tables, compared with loops that the tests simulate tick by tick."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy import signal

from rtloop.analysis.closed_loop import Loop, discrete_loop
from rtloop.analysis.learning import LARGEST_CONTRACTION, learning_gains
from rtloop.analysis.reference import ReferencePath
from rtloop.linear.discretise import discretise_controller
from rtloop.linear.transfer import Transfer

PERIOD_S, TICKS, SETTLED = 1e-4, 200, 40
TAPS, COMMAND_TAPS = np.array([0.5, 0.3, 0.2]), np.array([0.1, 0.05])
REFERENCE_UM = 20 * signal.sawtooth(2 * np.pi * np.arange(TICKS) / TICKS, 0.5)


def plant(hz: float, damping: float = 0.05) -> tuple[list[float], list[float]]:
    """Return numerator and denominator of ω²/(s² + 2ζω s + ω²)."""
    rate = 2 * np.pi * hz
    return [rate**2], [1.0, 2 * damping * rate, rate**2]


def controller(gain: float) -> tuple[list[float], list[float]]:
    """Return numerator and denominator of an integrator with a lag."""
    return [gain], [1 / 2000, 1.0, 0.0]


def loop(hz: float, gain: float) -> Loop:
    """Return the discretised loop of `plant` and `controller`, with taps."""
    path = ReferencePath(TAPS, COMMAND_TAPS)
    c = discretise_controller(Transfer.from_transfer_function(*controller(gain)), PERIOD_S, "tustin")
    return discrete_loop(c, Transfer.from_transfer_function(*plant(hz)), 0, path)


def simulate_last_period(hz: float, gain: float, table: np.ndarray) -> np.ndarray:
    """Return the position (µm) over the last of SETTLED periods of `table`, simulated with scipy tick by tick."""
    a, b, c, _, _ = signal.cont2discrete(signal.tf2ss(*plant(hz)), PERIOD_S, "zoh")
    k, h, g, d, _ = signal.cont2discrete(signal.tf2ss(*controller(gain)), PERIOD_S, "bilinear")
    r = np.tile(table[:, 0], SETTLED)
    input_um, feed_um = signal.lfilter(TAPS, 1, r), signal.lfilter(COMMAND_TAPS, 1, r) + np.tile(table[:, 1], SETTLED)
    x, s, position = np.zeros((2, 1)), np.zeros((2, 1)), np.zeros(r.size)
    for tick in range(r.size):
        position[tick] = (c @ x).item()
        error = input_um[tick] - position[tick]
        v = (g @ s + d * error).item() + feed_um[tick]
        x, s = a @ x + b * v, k @ s + h * error
    return position[-TICKS:]


@pytest.mark.parametrize("truth_hz", [570.0, 630.0])
def test_the_error_shrinks_as_promised_wherever_the_resonance_is(truth_hz):
    """Each learned harmonic's error falls at least by the contraction; the other harmonics keep their errors."""
    loops = [(f"{hz:g} Hz", loop(hz, 20.0)) for hz in (600.0, 570.0, 630.0)]
    gains = learning_gains(loops, TICKS)
    table, error_spectra = np.column_stack([REFERENCE_UM, 0 * REFERENCE_UM]), []
    for _ in range(4):
        error = REFERENCE_UM - simulate_last_period(truth_hz, 20.0, table)
        error_spectra.append(np.abs(np.fft.rfft(error)))
        table = gains.improve(table, error)
    learned = gains.is_learned
    assert learned[:10].all()
    assert not learned.all()
    for before, after in pairwise(error_spectra):
        assert np.all(after[learned] <= gains.contraction[learned] * before[learned] + 1e-6)
        np.testing.assert_allclose(after[~learned], before[~learned], atol=1e-6)
    assert np.linalg.norm(error_spectra[-1][learned]) < 0.01 * np.linalg.norm(error_spectra[0][learned])


def test_what_does_not_shrink_is_not_learned():
    """The plants respond with either sign at the second harmonic."""
    gains = learning_gains([(f"{hz:g} Hz", loop(hz, 5.0)) for hz in (90.0, 110.0, 400.0)], TICKS)
    assert gains.is_learned[1]
    assert np.all(gains.contraction[~gains.is_learned] >= LARGEST_CONTRACTION)
    assert not gains.is_learned.all()


def test_a_loop_that_is_unstable_somewhere_is_named():
    with pytest.raises(ValueError, match=r"the loop is unstable with resonance \+5 %; learning needs"):
        learning_gains([("resonance +0 %", loop(600.0, 20.0)), ("resonance +5 %", loop(600.0, 2000.0))], TICKS)


def test_a_period_whose_error_would_not_shrink_is_refused():
    """Resonances far below and far above the scan: the response has either sign, whatever the table."""
    with pytest.raises(ValueError, match=r"multiplies the error at 50 Hz by \d.*; allowed: below 0\.8"):
        learning_gains([("low", loop(20.0, 0.001)), ("high", loop(600.0, 0.001))], TICKS)
