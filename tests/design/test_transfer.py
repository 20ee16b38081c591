"""Transfer functions: four forms of one function respond alike, and malformed forms are refused."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from rtloop.design.paper import PAPER_C, PAPER_D
from rtloop.linear.transfer import Transfer

S = 2j * np.pi * np.geomspace(0.01, 1e5, 200)


def test_paper_d_eq_5() -> None:
    """Recomputed from the printed factors of eq (5)."""
    assert PAPER_D.dc_gain == pytest.approx(1.01086419, abs=1e-8)
    hz = np.linspace(590, 600, 20001)
    response = np.abs(PAPER_D.response(2j * np.pi * hz))
    assert response.max() == pytest.approx(6.8454, abs=1e-3)
    assert hz[response.argmax()] == pytest.approx(595.44, abs=0.05)
    assert PAPER_D.order == 8
    assert PAPER_D.is_stable
    assert PAPER_D.is_strictly_proper


def test_paper_c_eq_20() -> None:
    """Recomputed from the printed factors of eq (20)."""
    assert PAPER_C.dc_gain == pytest.approx(593.569162, abs=1e-5)
    assert PAPER_C.high_frequency_gain == pytest.approx(0.016, abs=1e-12)
    assert PAPER_C.order == 5
    assert PAPER_C.is_stable
    assert not PAPER_C.is_strictly_proper


def test_four_forms_of_one_transfer_function() -> None:
    factors = Transfer.from_factors(3.0, [[1, 4, 400]], [[1, 2], [2, 10, 300]])
    zpk = Transfer.from_zpk(np.roots([1, 4, 400]), [-2, *np.roots([2, 10, 300])], 1.5)
    numerator, denominator = 3.0 * np.array([1.0, 4, 400]), np.polymul([1, 2], [2, 10, 300])
    polynomials = Transfer.from_transfer_function(numerator, denominator)
    states = Transfer.from_state_space(*signal.tf2ss(numerator, denominator))
    expected = np.polyval(numerator, S) / np.polyval(denominator, S)
    for transfer in (factors, zpk, polynomials, states):
        assert transfer.response(S) == pytest.approx(expected, rel=1e-11)


@pytest.mark.parametrize("transfer", [PAPER_C, PAPER_D], ids=["C", "D"])
def test_state_space_of_a_stiff_system_comes_back(transfer: Transfer) -> None:
    """The state space is a modal sum that the test computes from the roots, with poles from 1 to 6e4 rad/s."""
    poles, zeros = transfer.poles, transfer.zeros
    residues = [transfer.gain * np.prod(p - zeros) / np.prod(p - np.delete(poles, i)) for i, p in enumerate(poles)]
    real = np.zeros((poles.size, poles.size))
    b, c = np.ones(poles.size), np.zeros(poles.size)
    for i, p in enumerate(poles):
        if p.imag > 0:
            real[i : i + 2, i : i + 2] = [[p.real, p.imag], [-p.imag, p.real]]
            c[i : i + 2] = residues[i].real - residues[i].imag, residues[i].real + residues[i].imag
        elif p.imag == 0:
            real[i, i], c[i] = p.real, residues[i].real
    converted = Transfer.from_state_space(real, b, c, transfer.high_frequency_gain)
    assert converted.zeros.size == zeros.size
    assert converted.response(S) == pytest.approx(transfer.response(S), rel=1e-6)


def test_zeros_at_infinity_of_a_state_space_are_left_out() -> None:
    """Three integrators in a row have no finite zero, and gain 6."""
    triple = Transfer.from_state_space(np.eye(3, k=1), [0, 0, 2], [3, 0, 0], 0)
    assert triple.zeros.size == 0
    assert triple.gain == pytest.approx(6)
    assert np.all(triple.poles == 0)
    assert math.isinf(triple.dc_gain)
    assert Transfer.from_state_space([[-1.0]], [1.0], [0.0], [0.0]).response(1j) == 0
    assert Transfer.from_state_space([], [], [], 2.5).dc_gain == 2.5


def test_dc_gain_cancels_at_zero() -> None:
    assert Transfer.from_factors(2, [[1, 0]], [[1, 0], [1, 4]]).dc_gain == 0.5
    assert Transfer.from_factors(2, [[1, 0]], [[1, 4]]).dc_gain == 0.0
    assert math.isinf(Transfer.from_factors(2, [], [[1, 0]]).dc_gain)


def test_double_root_of_a_quadratic_stays_double() -> None:
    assert Transfer.from_factors(1, [], [[1, 2000, 1e6]]).poles.tolist() == [-1000, -1000]


def test_product_multiplies_responses() -> None:
    assert (PAPER_C * PAPER_D).response(S) == pytest.approx(PAPER_C.response(S) * PAPER_D.response(S), rel=1e-12)


@given(st.lists(st.floats(-1e5, -1e-2), min_size=1, max_size=6), st.floats(-1e3, 1e3))
def test_factors_equal_zpk(poles: list[float], gain: float) -> None:
    written = Transfer.from_factors(gain, [], [[1, -p] for p in poles])
    assert written.response(S) == pytest.approx(Transfer.from_zpk([], poles, gain).response(S), rel=1e-12)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Transfer.from_zpk([], [math.nan], 1), "poles: .*nan.*finite"),
        (lambda: Transfer.from_zpk([math.inf], [-1], 1), "zeros: .*inf.*finite"),
        (lambda: Transfer.from_zpk([], [-1], math.inf), "gain: inf.*finite"),
        (lambda: Transfer.from_zpk([-1, -2], [-1], 1), "improper: 2 zeros and 1 poles"),
        (lambda: Transfer.from_zpk([], [-1 + 1j, -2], 1), "poles: .*without its complex conjugate.*pairs only"),
        (lambda: Transfer.from_factors(1, [], [[0, 0]]), "denominator: .* is zero"),
        (lambda: Transfer.from_transfer_function([1], [0]), "denominator: .* is zero"),
        (lambda: Transfer.from_factors(1, [[1, 1j]], [[1, 2, 3]]), "numerator: .*real"),
        (lambda: Transfer.from_factors(1, [[1, 1, 1]], [[1, 2]]), "improper"),
        (
            lambda: Transfer.from_state_space([[1, 2]], [1], [1], 0),
            "a: an array of 1 × 2; allowed: 1 × 1, for one input",
        ),
        (lambda: Transfer.from_state_space([[1]], [1, 2], [1], 0), "b: an array of 2; allowed: 1, for one input"),
        (lambda: Transfer.from_state_space([[1]], [1], [1], [math.nan]), "d: .*finite"),
    ],
)
def test_refusals(build, message) -> None:
    with pytest.raises(ValueError, match=message):
        build()
