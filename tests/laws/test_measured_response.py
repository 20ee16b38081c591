"""The frequency response that the conformance suite measures, against transfer functions written by hand."""

from __future__ import annotations

from cmath import exp
from typing import Any

import numpy as np
import pytest

from rtloop.laws import Controller, ControllerOptions
from rtloop.laws.conformance import LawConformance
from rtloop.laws.contract import Law
from rtloop.laws.shipped.options import PrandtlIshlinskiiOptions
from rtloop.laws.shipped.pid import Pid, PidOptions
from rtloop.laws.shipped.prandtl_ishlinskii import PrandtlIshlinskii
from tests.kernel.harness import EQ_4, PERIOD_S
from tests.laws.test_shipped import state_space

KP, KI_PER_S, NOTCH_HZ, ZETA, POLE_ZETA = 0.1, 600.0, 800.0, 0.02, 0.7
FREQUENCIES_HZ = np.array([8.0, 40.0, 100.0, 790.0, 800.0, 2000.0, 4900.0])
Z = np.exp(2j * np.pi * FREQUENCIES_HZ * PERIOD_S)


def make_suite(law: Law) -> LawConformance:
    """Return the conformance suite of a law."""
    conformance = LawConformance()
    conformance.law = law
    return conformance


def polynomial(damping: float) -> np.ndarray:
    """Return 1, a1, a2 of the pole pair exp(sT) of s² + 2ζω s + ω²."""
    pole = exp((-damping + 1j * np.sqrt(1 - damping**2)) * 2 * np.pi * NOTCH_HZ * PERIOD_S)
    return np.poly([pole, pole.conjugate()]).real


class PiNotch(Controller):
    """PI controller with a notch behind it."""

    coefficients = {"kp": float, "ki": float, "b": (float, 3), "a": (float, 2)}  # noqa: RUF012
    state = {"integral_um": float, "x": (float, 2)}  # noqa: RUF012

    def build(self) -> dict[str, Any]:
        zeros, poles = polynomial(ZETA), polynomial(POLE_ZETA)
        return {"kp": KP, "ki": KI_PER_S * self.period_s, "b": poles.sum() / zeros.sum() * zeros, "a": poles[1:]}

    def output(c: Any, s: Any, told: Any) -> float:
        return c.b[0] * (c.kp * told.error_um + s.integral_um) + s.x[0]

    def update(c: Any, s: Any, told: Any) -> None:
        pi_um = c.kp * told.error_um + s.integral_um
        s.x[0] = c.b[1] * pi_um - c.a[0] * told.command_um + s.x[1]
        s.x[1] = c.b[2] * pi_um - c.a[1] * told.command_um
        s.integral_um += c.ki * told.error_um


class Leak(Controller):
    """Lag of 1.3 s, whose transient is longer than the measured periods."""

    coefficients = {"a": float}  # noqa: RUF012
    state = {"y": float}  # noqa: RUF012

    def build(self) -> dict[str, Any]:
        return {"a": 1 - self.period_s / 1.3}

    def output(c: Any, s: Any, told: Any) -> float:
        return s.y

    def update(c: Any, s: Any, told: Any) -> None:
        s.y = c.a * s.y + told.error_um


class ChangingGain(Leak):
    """A law whose gain never stops changing."""

    def output(c: Any, s: Any, told: Any) -> float:
        return told.error_um * s.y

    def update(c: Any, s: Any, told: Any) -> None:
        s.y += 1e-3


def make_law(kind: type[Controller]) -> Controller:
    return kind(ControllerOptions(), PERIOD_S, None)


def test_a_pi_controller_with_a_notch_has_the_response_of_its_formula() -> None:
    zeros, poles = polynomial(ZETA), polynomial(POLE_ZETA)
    notch = poles.sum() / zeros.sum() * np.polyval(zeros, Z) / np.polyval(poles, Z)
    expected = notch * (KP + KI_PER_S * PERIOD_S / (Z - 1))
    measured = make_suite(make_law(PiNotch)).frequency_response(FREQUENCIES_HZ)
    np.testing.assert_allclose(measured, expected, rtol=1e-6)
    np.testing.assert_allclose(make_suite(make_law(PiNotch)).frequency_response(100.0, 7.0), expected[2:3], rtol=1e-6)


def test_a_long_memory_is_waited_for() -> None:
    frequencies_hz = np.array([50.0, 800.0])
    expected = 1 / (np.exp(2j * np.pi * frequencies_hz * PERIOD_S) - (1 - PERIOD_S / 1.3))
    np.testing.assert_allclose(make_suite(make_law(Leak)).frequency_response(frequencies_hz), expected, rtol=1e-4)


def test_the_derivative_of_the_position_has_the_sign_of_the_loop() -> None:
    law = Pid(PidOptions(kp=0.2, ki_per_s=100.0, kd_s=2e-3, filter_s=1e-3), PERIOD_S, None)
    measured = make_suite(law).frequency_response([50.0])[0]
    s = 2j * np.pi * 50.0
    assert measured == pytest.approx(0.2 + 100.0 / s + 2e-3 * s / (1 + 1e-3 * s), rel=0.03)


def test_each_command_of_several_axes_is_measured_for_each_error() -> None:
    law = state_space()
    frequencies_hz = np.array([300.0, 900.0])
    system = law.linear().system
    expected = [
        system.c @ np.linalg.solve(z * np.eye(len(system.a)) - system.a, system.b) + system.d
        for z in np.exp(2j * np.pi * frequencies_hz * PERIOD_S)
    ]
    np.testing.assert_allclose(make_suite(law).frequency_response(frequencies_hz), expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("frequency_hz", [0.0, -1.0, 5000.0, np.nan])
def test_a_frequency_that_no_sample_shows_is_refused(frequency_hz: float) -> None:
    with pytest.raises(ValueError, match=r"frequencies_hz: .*; allowed: above 0, below 5000 Hz"):
        make_suite(make_law(PiNotch)).frequency_response([100.0, frequency_hz])


def test_what_does_not_settle_and_what_has_no_error_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rtloop.laws.measured_response.MOST_TICKS", 5000)
    with pytest.raises(ValueError, match="the response at 100 Hz has not settled after 5,000 ticks"):
        make_suite(make_law(ChangingGain)).frequency_response(100.0)
    feedforward = PrandtlIshlinskii(PrandtlIshlinskiiOptions.model_validate(EQ_4), PERIOD_S, None)
    with pytest.raises(ValueError, match="a feedforward; only a controller has a frequency response from error"):
        make_suite(feedforward).frequency_response(100.0)
