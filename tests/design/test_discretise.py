"""Discretised controllers: the response of the state space against C(z) computed with 120 digits or more."""

import cmath
import math
from itertools import chain

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from rtloop.design.paper import PAPER_C
from rtloop.linear.discretise import discretise_controller
from rtloop.linear.transfer import Transfer

T = 1e-4
HZ = np.array([0.1, 3.0, 107.9, 350.0, 595.5, 640.0, 2000.0, 4400.0])
METHODS = [("matched", None), ("tustin", None), ("tustin", 595.5), ("foh", None), ("zoh", None)]


def exact_c(zeros, poles, gain, method, prewarp_hz, hz):
    """Return C(z) at `hz` by definition, with 120 digits or more. Holds: repeated poles are set about 1e-30 apart."""
    with mp.workdps(120 + 35 * len(poles)):
        period = mp.mpf(T)
        z = mp.exp(2j * mp.pi * mp.mpf(hz) * period)
        zs, ps = [mp.mpmathify(complex(x)) for x in zeros], [mp.mpmathify(complex(x)) for x in poles]
        if method == "tustin":
            w0 = 2 * mp.pi * mp.mpf(prewarp_hz) if prewarp_hz else None
            s = (z - 1) / (z + 1) * (w0 / mp.tan(w0 * period / 2) if w0 else 2 / period)
            return complex(gain * mp.fprod(s - x for x in zs) / mp.fprod(s - x for x in ps))
        if method == "matched":
            zd, pd = [mp.exp(x * period) for x in zs], [mp.exp(x * period) for x in ps]
            zd += [mp.mpf(-1)] * (len(pd) - len(zd))
            near_0 = mp.mpf("1e-40")  # the gains are compared near s = 0, where that of an integrator is finite
            continuous = gain * mp.fprod(near_0 - x for x in zs) / mp.fprod(near_0 - x for x in ps)
            near_1 = mp.exp(near_0 * period)
            discrete = mp.fprod(near_1 - x for x in zd) / mp.fprod(near_1 - x for x in pd)
            return complex(continuous / discrete * mp.fprod(z - x for x in zd) / mp.fprod(z - x for x in pd))
        ps = [p + (abs(p) + 1) * (i + 1) * mp.mpf("1e-30") for i, p in enumerate(ps)]
        total = mp.mpf(gain if len(zs) == len(ps) else 0)
        for i, p in enumerate(ps):
            residue = gain * mp.fprod(p - x for x in zs) / mp.fprod(p - q for j, q in enumerate(ps) if j != i)
            pole_z = mp.exp(p * period)
            if method == "zoh":
                total += residue * (pole_z - 1) / p / (z - pole_z)
            else:  # (z − 1)²/(Tz) times the z transform of the sampled ramp response
                total += residue * ((z - 1) ** 2 / (z - pole_z) - (z - 1) - p * period) / (period * p**2)
        return complex(total)


def worst_error(transfer: Transfer, method, prewarp_hz, hz=HZ) -> float:
    """Return the largest error relative to |C(z)|, or to 1e-5 of the summed terms of c·x + d e where |C(z)| is smaller.

    Ten coinciding zeros leave only rounding errors of that sum, in any realisation. The divisor is at least 1e-9 of the
    largest |C(z)|.
    """
    controller = discretise_controller(transfer, T, method, prewarp_hz)
    expected = np.array([exact_c(transfer.zeros, transfer.poles, transfer.gain, method, prewarp_hz, f) for f in hz])
    states = controller.system.states(np.exp(2j * np.pi * np.asarray(hz) * T))
    terms = np.abs(states) @ np.abs(controller.c) + abs(controller.d)
    size = np.maximum(np.maximum(np.abs(expected), 1e-5 * terms), 1e-9 * np.abs(expected).max())
    return float(np.max(np.abs(controller.response(hz) - expected) / size))


def rounding_error(controller, hz) -> float:
    """Return the relative error of C(z), as in `worst_error`, caused by rounding A: ε κ(zI − A) |c||x| / |C|."""
    max_error = 0.0
    for z in np.exp(2j * np.pi * np.asarray(hz) * T):
        terms = np.abs(controller.system.states(z)[0]) @ np.abs(controller.c) + abs(controller.d)
        size = max(abs(controller.system.response(z)[0]), 1e-5 * terms)
        pencil = z * np.eye(controller.b.size) - controller.a
        max_error = max(
            max_error, np.finfo(float).eps * np.linalg.cond(pencil) * terms / size if controller.b.size else 0.0
        )
    return max_error


@pytest.mark.parametrize("distance", [1e-16, 3.6e-15, 1e-12, 1e-8])
@pytest.mark.parametrize(("method", "prewarp_hz"), METHODS)
def test_roots_next_to_0_each_other_and_half_the_rate_lose_few_digits(method, prewarp_hz, distance):
    half_rate = np.pi / T
    near_half_rate = [complex(-50, sign * half_rate * (1 - distance)) for sign in (1, -1)]
    for zeros, poles in [
        ([-300.0], [-distance, -4000.0]),
        ([-300.0], [distance, -4000.0]),
        ([-distance], [-300.0, -4000.0]),
        ([distance], [-300.0, -4000.0]),
        ([-30.0, -300.0], [-distance, -2 * distance, -4000.0]),
        ([-30.0, -300.0], [distance * (-1 + 1j), distance * (-1 - 1j), -4000.0]),
        ([-30.0], [-300.0, -300.0 * (1 + distance), -4000.0]),
        ([-30.0, -300.0], [-300.0 * (1 + distance), -4000.0, -10.0]),
        ([-30.0], [complex(-distance, 3740), complex(-distance, -3740), -4000.0]),
        ([-30.0], [*near_half_rate, -4000.0]),
        (near_half_rate, [-30.0, -300.0, -4000.0]),
    ]:
        error = worst_error(Transfer.from_zpk(zeros, poles, 2.0), method, prewarp_hz, HZ[[0, 2, 6]])
        assert error < 1e-10, (zeros, poles)


def test_a_zero_that_cancels_the_integrator_is_refused_with_its_place():
    for zero, pole in [(0.0, 0.0), (-2e-13, -1e-13)]:
        with pytest.raises(ValueError, match="cancels the controller's integrator"):
            discretise_controller(Transfer.from_zpk([zero], [pole, -4000.0], 1.0), T)


@pytest.mark.parametrize(("method", "prewarp_hz"), METHODS)
def test_paper_controller_to_1e9(method, prewarp_hz) -> None:
    """The controller is eq (20), sampled at 10 kHz."""
    assert worst_error(PAPER_C, method, prewarp_hz) < 1e-9


REPEATED = {
    "double real": Transfer.from_factors(2e3, [[1, 30]], [[1, 200, 1e4]]),
    "triple and a pair": Transfer.from_zpk([-50, -3000], [-900, -900, -900, -20 + 3700j, -20 - 3700j], 1e9),
    "double pair": Transfer.from_zpk([-3, -4], [-50 + 3000j, -50 - 3000j] * 2, 1e8),
    "cluster": Transfer.from_zpk([-10], [-100, -100.0001, -100.00015], 1e3),
    "almost a double real": Transfer.from_zpk([], [-500 + 1e-4j, -500 - 1e-4j], 1e5),
    "two integrators": Transfer.from_factors(40, [[1, 20], [1, 300]], [[1, 0], [1, 0], [1, 9000]]),
    "order 10 in cascade": Transfer.from_factors(1e40, [], [[1, 2e4, 1e8]] * 5),
    "order 9, biproper": Transfer.from_zpk([-70.0] * 9, [-700.0] * 9, 3.0),
    "zero on a pole": Transfer.from_zpk([-700.0], [-700.0, -700.0], 3.0),
}
DISTINCT = {
    "integrator": Transfer.from_factors(5, [[1, 40]], [[1, 0], [1, 6000]]),
    "fast beside slow": Transfer.from_zpk([], [-1, -9e6], 1e7),
    "odd": Transfer.from_zpk([-2, -3 + 40j, -3 - 40j], [-1, -300, -8 + 700j, -8 - 700j, -5000], 7.0),
    "unstable zero": Transfer.from_factors(-20.7, [[1, -1.22e5]], [[1, 925, 4.59e5]]),
}


@pytest.mark.parametrize(("method", "prewarp_hz"), METHODS)
@pytest.mark.parametrize("name", [*REPEATED, *DISTINCT])
def test_every_shape_to_1e9(name, method, prewarp_hz) -> None:
    transfer = (REPEATED | DISTINCT)[name]
    assert worst_error(transfer, method, prewarp_hz) < 1e-9
    form = discretise_controller(transfer, T, method, prewarp_hz).form
    assert form == "cascade" if name in REPEATED else form == "modal"


rates = st.floats(0, 4.6).map(lambda power: -(10**power))
pairs = st.tuples(st.floats(1.5, 4.3), st.floats(0.005, 0.95)).map(
    lambda p: [10 ** p[0] * cmath.exp(1j * sign * (math.pi - math.acos(p[1]))) for sign in (1, -1)]
)
roots = st.tuples(st.lists(rates, max_size=3), st.lists(pairs, max_size=3)).map(lambda r: [*r[0], *chain(*r[1])])


@settings(max_examples=100, deadline=None)
@given(poles=roots, zeros=roots, repeat=st.booleans(), integrator=st.booleans(), rule=st.sampled_from(METHODS))
def test_any_controller(poles, zeros, repeat, integrator, rule) -> None:
    """The state space equals C(z), the anti-windup is stable and exact, the steady state correct, for any poles.

    The tolerance is 1e-7: zeros near 3 Hz among distant poles also cancel inside the cascade and cost digits (six zeros
    beside a triple pole gave 1.3e-8). Where eight zeros cancel, zI − A is nearly singular, and the tolerance is the
    error from rounding A alone.
    """
    poles = (poles + poles if repeat and len(poles) <= 5 else poles) + ([0.0] if integrator else [])
    zeros = zeros[: len(poles)] if len(zeros) <= len(poles) else []
    transfer = Transfer.from_zpk(zeros, poles, float(np.prod([abs(p) or 1 for p in poles])))
    controller = discretise_controller(transfer, T, *rule)
    assert worst_error(transfer, *rule, hz=HZ[1::3]) < max(1e-7, rounding_error(controller, HZ[1::3]))
    a, b, c, m = controller.a, controller.b, controller.c, controller.antiwindup
    if np.abs(c).max(initial=0) > 1e-6:  # otherwise zeros cancel all poles
        assert c @ m == pytest.approx(1.0, rel=1e-9)
        assert np.abs(np.linalg.eigvals(a - np.outer(a @ m, c))).max() < 1
    if not integrator:
        x = controller.steady_state_gain
        assert a @ x + b == pytest.approx(x, rel=1e-9, abs=1e-12)
    for row, (first, end) in zip(a, controller.row_bands, strict=True):
        assert np.all(row[:first] == 0)
        assert np.all(row[end:] == 0)


@pytest.mark.parametrize(("method", "scipy_method"), [("tustin", "bilinear"), ("zoh", "zoh"), ("foh", "foh")])
def test_against_scipy(method, scipy_method) -> None:
    """The system is well conditioned; the oracle is scipy.signal.cont2discrete."""
    numerator, denominator = [2.0, 300.0, 5e4], np.polymul([1, 100], [1, 150, 9e4])
    num, den, _ = signal.cont2discrete((numerator, denominator), 1e-3, scipy_method)
    controller = discretise_controller(Transfer.from_transfer_function(numerator, denominator), 1e-3, method)
    _, expected = signal.freqz(np.ravel(num), den, np.pi * np.array([0.01, 0.1, 0.5, 0.9]))
    assert controller.response([5, 50, 250, 450]) == pytest.approx(expected, rel=1e-9)


def test_modal_blocks_and_bands_of_the_paper() -> None:
    """Three real poles and a pair: rows touch 1, 1, 1, 2, 2 columns; rotations are scaled rotations."""
    controller = discretise_controller(PAPER_C, T, "matched")
    assert controller.form == "modal"
    assert controller.row_bands.tolist() == [[0, 1], [1, 2], [2, 3], [3, 5], [3, 5]]
    assert controller.a[3, 3] == controller.a[4, 4]
    assert controller.a[3, 4] == -controller.a[4, 3]


def test_states_are_of_comparable_size() -> None:
    """Each state's largest response to a unit sine lies near 1, though the modes' gains span 0.1 to 500."""
    controller = discretise_controller(PAPER_C, T, "matched")
    z = np.exp(2j * np.pi * np.geomspace(0.001, 4999, 2000) * T)
    peaks = np.abs(controller.system.states(z)).max(axis=0)
    assert np.all((peaks > 0.5) & (peaks < 2))


def test_static_controller_has_no_states() -> None:
    for transfer in (Transfer.from_zpk([], [], 2.5), Transfer.from_zpk([], [-1], 0.0)):
        controller = discretise_controller(transfer, T, "matched")
        assert controller.order == 0
        assert controller.a.shape == (0, 0)
        assert controller.row_bands.shape == (0, 2)
        assert controller.antiwindup.size == 0
        assert controller.steady_state_gain.size == 0
        assert controller.d == controller.dc_gain == transfer.gain * (not transfer.order)
        assert np.all(controller.response([1, 10]) == controller.d)


def test_integrating_state_takes_the_correction_and_has_no_steady_state() -> None:
    controller = discretise_controller(DISTINCT["integrator"], T, "tustin")
    integrating = np.flatnonzero(np.diag(controller.a) == 1)
    assert integrating.size == 1
    assert math.isinf(controller.dc_gain)
    assert np.all(controller.steady_state_gain[integrating] == 0)
    assert (controller.c * controller.antiwindup)[integrating] == pytest.approx(1, abs=1e-6)


def test_dc_gain_is_kept() -> None:
    for method, prewarp_hz in METHODS:
        assert discretise_controller(PAPER_C, T, method, prewarp_hz).dc_gain == pytest.approx(593.569162, abs=1e-5)


def test_unstable_controller_is_limited_stably() -> None:
    controller = discretise_controller(Transfer.from_factors(10, [[1, 50]], [[1, -30], [1, 700]]), T, "matched")
    limited = controller.a - np.outer(controller.a @ controller.antiwindup, controller.c)
    assert np.abs(np.linalg.eigvals(limited)).max() < 1


@pytest.mark.parametrize(
    ("controller", "arguments", "message"),
    [
        (PAPER_C, (0.0,), "period_s: 0.0; allowed: a positive"),
        (PAPER_C, (math.nan,), "period_s: nan"),
        (PAPER_C, (T, "euler"), "method: 'euler'; allowed: matched, tustin, foh, zoh"),
        (PAPER_C, (T, "matched", 595.5), "prewarp_hz: 595.5 needs method 'tustin', but method is 'matched'"),
        (
            PAPER_C,
            (T, "tustin", 5000.0),
            "prewarp_hz: 5000.0 Hz; allowed: between 0 and half the sampling rate, 5000 Hz",
        ),
        (Transfer.from_zpk([-1], [8e6], 1), (T, "matched"), r"poles: the largest real part is 8e\+06 rad/s; allowed"),
        (Transfer.from_zpk([2 / T], [-1], 1), (T, "tustin"), "to infinity"),
        (Transfer.from_zpk([30.0], [30.0, -5.0], 1.0), (T, "matched"), "controller: "),
    ],
)
def test_refusals(controller, arguments, message) -> None:
    """Arguments out of range; roots that a rule cannot map; an unstable mode that the output does not see."""
    with pytest.raises(ValueError, match=message):
        discretise_controller(controller, *arguments)


def test_a_zero_too_far_to_the_right_to_be_seen_leaves_its_gain() -> None:
    """The sum z − exp(800) rounds to −exp(800): the controller becomes k/(z − p) with C(1) = C(0)."""
    discrete = discretise_controller(Transfer.from_zpk([8e6], [-100.0], -1e-5), T, "matched")
    assert discrete.zeros.size == 0
    assert discrete.gain / (1 - math.exp(-100.0 * T)) == pytest.approx(0.8, rel=1e-12)
