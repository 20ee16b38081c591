"""Conversion to and from python-control keeps the responses; systems that cannot be converted raise an error."""

import control
import numpy as np
import pytest

from rtloop.analysis.closed_loop import continuous_loop, discrete_loop
from rtloop.design.identification.frequency_response import FrequencyResponse
from rtloop.design.interchange import from_control, to_control
from rtloop.design.paper import PAPER_C, PAPER_D
from rtloop.linear.discretise import discretise_controller
from rtloop.linear.transfer import Transfer

HZ = np.geomspace(0.1, 4900, 100)
S = 2j * np.pi * HZ
RUNNING = discretise_controller(PAPER_C, 1e-4)
GAIN, INTEGRATOR = Transfer.from_zpk([], [], 3.0), Transfer.from_zpk([], [0.0], 2.0)


@pytest.mark.parametrize("system", [PAPER_C, PAPER_D, GAIN, INTEGRATOR])
def test_a_system_in_s_goes_out_and_comes_back(system) -> None:
    exported = to_control(system)
    assert exported(S) == pytest.approx(system.response(S), rel=1e-11)
    imported = from_control(exported)
    assert imported.response(S) == pytest.approx(system.response(S), rel=1e-9)
    assert imported.order == system.order


def test_the_controller_that_runs_goes_out_at_its_period() -> None:
    exported = to_control(RUNNING)
    assert exported.dt == 1e-4
    assert exported(np.exp(S * 1e-4)) == pytest.approx(RUNNING.response(HZ), rel=1e-12)


def test_a_loop_goes_out_cut_open_and_with_its_delay() -> None:
    assert to_control(continuous_loop(PAPER_C, PAPER_D))(S) == pytest.approx(
        PAPER_C.response(S) * PAPER_D.response(S), rel=1e-10
    )
    delayed, undelayed = (to_control(discrete_loop(RUNNING, PAPER_D, ticks)) for ticks in (2, 0))
    z = np.exp(S * 1e-4)
    assert delayed(z) == pytest.approx(undelayed(z) / z**2, rel=1e-8)


def test_a_quotient_of_polynomials_comes_in() -> None:
    imported = from_control(control.tf([3.0, 6.0], [1.0, 2.0, 26.0]))
    assert imported.zeros == pytest.approx([-2.0])
    assert sorted(imported.poles, key=lambda pole: pole.imag) == pytest.approx([-1 - 5j, -1 + 5j])
    assert imported.gain == 3.0


def test_a_measured_response_goes_out_and_comes_back() -> None:
    measured = FrequencyResponse(HZ, PAPER_D.response(S), np.full(HZ.size, 0.99))
    exported = to_control(measured)
    assert isinstance(exported, control.FrequencyResponseData)
    assert exported.omega == pytest.approx(2 * np.pi * HZ)
    imported = from_control(exported)
    assert imported.hz == pytest.approx(HZ, rel=1e-15)
    assert imported.response.tobytes() == measured.response.tobytes()
    assert imported.is_trusted.all()
    assert imported.resolution_hz == pytest.approx(np.max(np.diff(HZ)))
    assert from_control(control.frd([1.0], [5.0])).resolution_hz == 0.0


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (control.ss(-np.eye(2), np.eye(2), np.eye(2), 0 * np.eye(2)), "2 inputs and 2 outputs; allowed: one of each"),
        (control.tf([1.0], [1.0, -0.5], 0.1), r"dt = 0.1: discrete time; allowed: continuous time \(dt = 0\)"),
        (control.tf([1.0, 0.0, 0.0], [1.0, 1.0]), "improper: 2 zeros and 1 poles"),
        (PAPER_C, "Transfer; allowed: StateSpace, "),
        (control.tf([np.nan], [1.0, 1.0]), "not finite"),
    ],
)
def test_what_cannot_be_taken_over_is_named(system, message) -> None:
    with pytest.raises(ValueError, match=message):
        from_control(system)
