"""D(s) and the sensor's bandwidth against 60-digit arithmetic and scipy, from the printed factors of eq (5)."""

from __future__ import annotations

from functools import reduce
from typing import Any

import mpmath
import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from rtloop.hil.options import CreepOptions, DynamicsOptions, SensorOptions
from rtloop.hil.rig import build_rig

# Eq (5), highest power of s first.
GAIN = -20.7
NUMERATOR = [[1, -1.22e5], [1, 2.99e4], [1, -2.776e4], [1, -1.07e4], [1, 1430], [1, 4.3e4, 3.2e9]]
DENOMINATOR = [[1, 925, 4.59e5], [1, 55, 1.4e7], [1, 1.54e4, 4e9], [1, 964, 3.95e9]]

PERIOD = 1e-4


def product(factors):
    """Return the product of polynomials in the precision of mpmath's context; coefficients, highest power first."""
    return reduce(np.convolve, [np.array([mpmath.mpf(number) for number in factor]) for factor in factors])


def simulate_hold(numerator, denominator, drive, period):
    """Return the output at each k·period of a strictly proper system with held inputs, by a matrix exponential."""
    order = len(denominator) - 1
    # In units of the period the coefficients stay moderate.
    scaled_denominator = [c * mpmath.mpf(period) ** i for i, c in enumerate(denominator)]
    scaled_numerator = [c * mpmath.mpf(period) ** (order - len(numerator) + 1 + i) for i, c in enumerate(numerator)]
    companion = mpmath.matrix(np.eye(order + 1, k=1).tolist())  # its last column is the input
    for i in range(order):
        companion[order - 1, i] = -scaled_denominator[order - i]
    transition = mpmath.expm(companion, method="taylor")
    state, out = mpmath.zeros(order, 1), []
    for u in drive:
        out.append(float(mpmath.fsum(c * part for c, part in zip(scaled_numerator[::-1], state, strict=False))))
        state = transition[:order, :order] * state + transition[:order, order] * mpmath.mpf(u)
    return np.array(out)


def eq_5(s):
    """Return D(s) of eq (5) in complex doubles."""
    numerator, denominator = (np.prod([np.polyval(f, s) for f in factors], 0) for factors in (NUMERATOR, DENOMINATOR))
    return GAIN * numerator / denominator


def kernel_poles(options, period=PERIOD):
    """Return the poles in z of the modes that the kernel uses, one of each conjugate pair."""
    coefficients, _ = build_rig(options, ["x"], period)
    count = coefficients[0].mode_count
    return coefficients[0].mode_real[:count] + 1j * coefficients[0].mode_imag[:count]


def is_among(pole, poles):
    """Return whether a pole, or its conjugate, is one of `poles`."""
    return min(np.abs(poles - pole).min(), np.abs(poles - np.conj(pole)).min()) < 1e-12


@pytest.mark.parametrize("period", [1e-4, 1e-5])
def test_hold_is_exact(run, ideal, period):
    drive = np.random.default_rng(2).normal(0, 5, 80)
    with mpmath.workdps(60):
        expected = simulate_hold([GAIN * c for c in product(NUMERATOR)], product(DENOMINATOR), drive, period)
    np.testing.assert_allclose(run(drive, ideal(), period).true_um, expected, rtol=0, atol=1e-9)


def test_static_gain_and_overshoot(run, ideal):
    """D(0) = 1.01086419 and a step overshoots by 14.474 % of it."""
    step = run(np.ones(400_001), ideal(), 2e-6).true_um
    assert step[-1] == pytest.approx(1.01086419, abs=1e-8)
    assert 100 * (step.max() / 1.01086419 - 1) == pytest.approx(14.474, abs=0.02)


def test_resonance_peak(run, ideal):
    """|D| peaks at 6.8454, 595.44 Hz: from the rig's impulse response, by a Fourier sum at 100 kHz."""
    period, ticks = 1e-5, 60_000
    impulse = run(np.eye(1, ticks)[0], ideal(), period).true_um
    hz = np.arange(594.5, 596.5, 0.01)
    hold = (1 - np.exp(-2j * np.pi * hz * period)) / (2j * np.pi * hz * period)
    gain = np.abs([impulse @ np.exp(-2j * np.pi * f * period * np.arange(ticks)) for f in hz] / hold)
    assert gain.max() == pytest.approx(6.8454, abs=2e-3)
    assert hz[gain.argmax()] == pytest.approx(595.44, abs=0.05)
    assert gain.max() == pytest.approx(np.abs(eq_5(2j * np.pi * hz)).max(), rel=2e-4)


def test_sensor_bandwidth_hides_nothing_of_the_truth(run, ideal):
    """The sensor's lag leaves the true position the same; the reading is D(s)·ω/(s + ω), at 60 digits."""
    drive = np.random.default_rng(3).normal(0, 5, 60)
    sensor = SensorOptions(um_per_v=1.0, noise_um=0.0, resolution_um=0.0, bandwidth_hz=1000.0)
    lagged = run(drive, ideal(sensor=sensor))
    corner = 2 * np.pi * 1000.0
    with mpmath.workdps(60):
        numerator = [GAIN * corner * c for c in product(NUMERATOR)]
        expected = simulate_hold(numerator, product([*DENOMINATOR, [1, corner]]), drive, PERIOD)
    np.testing.assert_allclose(lagged.adc_v, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(lagged.true_um, run(drive, ideal()).true_um, rtol=0, atol=1e-12)


@pytest.mark.parametrize("damping", [0.05, 3.0])
def test_own_factors_and_bandwidth_against_scipy(run, ideal, damping):
    """A resonator at 100 Hz, or two real poles, behind a lag at 300 Hz: scipy's zero-order hold."""
    natural, corner = 2 * np.pi * 100, 2 * np.pi * 300
    factors = [1.0, 2 * damping * natural, natural**2]
    dynamics = DynamicsOptions(form="factors", gain=3 * natural**2, denominator=(tuple(factors),))
    sensor = SensorOptions(um_per_v=1.0, noise_um=0.0, resolution_um=0.0, bandwidth_hz=300.0)
    drive = np.random.default_rng(4).normal(0, 1, 400)
    signals = run(drive, ideal(dynamics=dynamics, sensor=sensor))
    for output, denominator, gain in (
        (signals.true_um, factors, 3 * natural**2),
        (signals.adc_v, np.polymul(factors, [1, corner]), 3 * natural**2 * corner),
    ):
        discrete: Any = scipy.signal.cont2discrete(([gain], denominator), PERIOD)
        expected = scipy.signal.lfilter(np.ravel(discrete[0]), discrete[1], drive)
        np.testing.assert_allclose(output, expected, rtol=0, atol=1e-8)


def test_zeros_and_poles_are_the_same_plant(run, ideal):
    """Both forms give (s + 10) / ((s + 20)(s² + 40 s + 2500))."""
    factors = DynamicsOptions(form="factors", gain=4e4, numerator=((1, 10),), denominator=((2, 40), (0.5, 20, 1250)))
    imag = np.sqrt(2500 - 400)
    zpk = DynamicsOptions(form="zpk", gain=4e4, zeros=((-10, 0),), poles=((-20, 0), (-20, imag), (-20, -imag)))
    drive = np.sin(np.arange(300) / 30)
    by_factors_um, by_roots_um = (run(drive, ideal(dynamics=form)).true_um for form in (factors, zpk))
    np.testing.assert_allclose(by_factors_um, by_roots_um, rtol=0, atol=1e-12)


def test_direct_path_is_seen_after_one_period(run, ideal):
    """(s + 200)/(s + 100) held at 1 from rest: 1 at once, 2 in the end, 2 − exp(−100 t) between."""
    dynamics = DynamicsOptions(form="zpk", gain=1.0, zeros=((-200, 0),), poles=((-100, 0),))
    step = run(np.ones(1000), ideal(dynamics=dynamics)).true_um
    ticks = np.arange(1, 1000)
    np.testing.assert_allclose(step[1:], 2 - np.exp(-100 * PERIOD * ticks), rtol=1e-12)
    assert step[0] == 0


def test_a_direct_path_does_not_pass_a_sensor_of_finite_bandwidth(run, ideal):
    """(s + 200)/(s + 100) behind ω/(s + ω): the first sample after a step is far from 1."""
    dynamics = DynamicsOptions(form="zpk", gain=1.0, zeros=((-200, 0),), poles=((-100, 0),))
    sensor = SensorOptions(um_per_v=1.0, noise_um=0.0, resolution_um=0.0, bandwidth_hz=200.0)
    corner, drive = 2 * np.pi * 200, np.random.default_rng(5).normal(0, 1, 200)
    sensed = run(drive, ideal(dynamics=dynamics, sensor=sensor)).adc_v
    discrete: Any = scipy.signal.cont2discrete(([corner, 200 * corner], np.polymul([1, 100], [1, corner])), PERIOD)
    np.testing.assert_allclose(sensed, scipy.signal.lfilter(np.ravel(discrete[0]), discrete[1], drive), atol=1e-10)


def test_a_mode_slower_than_a_radian_a_second_is_one_pair(run, ideal):
    """s² + 0.2 s + 0.26, of poles −0.1 ± 0.5j: a rig that counts the second pole as another mode answers twice."""
    dynamics = DynamicsOptions(form="zpk", gain=0.26, poles=((-0.1, 0.5), (-0.1, -0.5)))
    discrete: Any = scipy.signal.cont2discrete(([0.26], [1, 0.2, 0.26]), 0.01)
    expected = scipy.signal.lfilter(np.ravel(discrete[0]), discrete[1], np.ones(2000))
    poles = kernel_poles(ideal(dynamics=dynamics), 0.01)
    assert len(poles) == 1
    coefficients, _ = build_rig(ideal(dynamics=dynamics), ["x"], 0.01)
    axis = coefficients[0]
    residue = axis.true_real[0] - 1j * axis.true_imag[0]
    ticks = np.arange(2000)
    step = np.real(residue * (1 - poles[0] ** ticks) / (1 - poles[0]))
    np.testing.assert_allclose(step, expected, atol=1e-9)


def test_integrator(run, ideal):
    dynamics = DynamicsOptions(form="zpk", gain=100.0, poles=((0, 0),))
    np.testing.assert_allclose(run(np.ones(50), ideal(dynamics=dynamics)).true_um, 0.01 * np.arange(50), atol=1e-14)


@settings(max_examples=25)
@given(st.floats(-0.2, 0.2).filter(lambda shift: abs(shift) > 1e-6))
def test_shift_moves_the_resonance_only(ideal, shift):
    """The pair of s² + 55 s + 1.4e7 goes to (1 + shift) times its place (constant damping ratio); D(0) stays."""
    shifted = ideal(dynamics=DynamicsOptions(resonance_shift=shift))
    shifted_poles = kernel_poles(shifted)
    for i, (_, b, c) in enumerate(DENOMINATOR):
        pole = complex(-b / 2, np.sqrt(c - b * b / 4))
        assert is_among(np.exp((1 + shift if i == 1 else 1) * pole * PERIOD), shifted_poles)
    coefficients, _ = build_rig(shifted, ["x"], PERIOD)
    real, imag = coefficients[0].true_real[: shifted_poles.size], coefficients[0].true_imag[: shifted_poles.size]
    dc = ((real - 1j * imag) / (1 - shifted_poles)).real.sum()
    assert dc == pytest.approx(1.01086419, abs=1e-8)


def test_creep_is_a_sum_of_lags(run, ideal):
    """A step of 2 µm grows to 2·(1 + Σ c_i (1 − exp(−t/τ_i)))."""
    creep = CreepOptions(gains=(0.1, 0.05), time_constants_s=(0.02, 0.5))
    y = run(np.full(2001, 2.0), ideal(creep=creep)).hysteresis_um[1:]
    t = PERIOD * np.arange(2000)
    expected = 2 * (1 + 0.1 * (1 - np.exp(-t / 0.02)) + 0.05 * (1 - np.exp(-t / 0.5)))
    np.testing.assert_allclose(y, expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"form": "zpk", "gain": 1.0, "poles": ((-1.0, 0.0), (-1.0, 0.0))}, "poles near -1.* repeated"),
        ({"form": "zpk", "gain": 1.0, "zeros": ((-1.0, 0.0),)}, "improper: 1 zeros and 0 poles"),
        ({"form": "zpk", "gain": 1.0, "poles": ((-1.0, 2.0),)}, "without its complex conjugate"),
        ({"form": "zpk", "gain": 1.0, "poles": tuple((-1.0 - i, 0.0) for i in range(17))}, "17 modes.*at most 16"),
        ({"form": "zpk", "gain": 1.0, "poles": ((1e9, 0.0),)}, "too fast to compute with a period of 0.0001 s"),
        (
            {"form": "zpk", "gain": 1.0, "poles": ((-1.0, 0.0),), "resonance_shift": 0.1},
            "resonance_shift: 0.1; allowed: 0",
        ),
    ],
)
def test_dynamics_that_cannot_be_built_are_refused(ideal, parts, message):
    with pytest.raises(ValueError, match=f"axis x: dynamics: .*{message}"):
        build_rig(ideal(dynamics=DynamicsOptions(**parts)), ["x"], PERIOD)


def test_a_bandwidth_that_repeats_a_pole_is_refused(ideal):
    dynamics = DynamicsOptions(form="zpk", gain=1.0, poles=((-2 * np.pi * 50, 0.0),))
    with pytest.raises(ValueError, match="sensor bandwidth of 50 Hz puts the sensor's pole on the plant's pole"):
        build_rig(ideal(dynamics=dynamics, sensor=SensorOptions(bandwidth_hz=50.0)), ["x"], PERIOD)
