"""Coupled loops of several axes against python-control, and the disk margin against a search over gain changes."""

from __future__ import annotations

import control
import numpy as np
import pytest

from rtloop.analysis.coupled_loop import CoupledLoop, CoupledPlant, coupling_matrix
from rtloop.foundation.arrays import Real
from rtloop.linear.coupled_systems import CoupledSystem, SampledCoupledSystem, block_diagonal_system, tustin
from rtloop.linear.realisation import System
from rtloop.linear.transfer import Transfer

PERIOD_S = 1e-3


def draw_loop(axes: int, seed: int, first_axis: str = "") -> tuple[CoupledLoop, control.StateSpace, control.StateSpace]:
    """Return a loop of integrators and coupled second-order plants; the same controller and plant in python-control.

    With `first_axis` "receives", the first axis acts on no other, and the others act on it ten times as much; with
    "acts", the other way round.
    """
    random = np.random.default_rng(seed)
    omegas, dampings = random.uniform(60, 200, axes), random.uniform(0.1, 0.8, axes)
    transfers = tuple(
        Transfer.from_transfer_function([w**2], [1.0, 2 * z * w, w**2]) for w, z in zip(omegas, dampings, strict=True)
    )
    coupling = np.eye(axes) + 0.2 * random.uniform(-1, 1, (axes, axes)) * (1 - np.eye(axes))
    delays = tuple(int(ticks) for ticks in random.integers(0, 3, axes))
    gains = 10.0 * PERIOD_S * (np.eye(axes) + 0.2 * random.uniform(-1, 1, (axes, axes)))
    if first_axis:
        for matrix in (coupling, gains):
            large, zero = (matrix[0, 1:], matrix[1:, 0])[:: 1 if first_axis == "receives" else -1]
            large *= 10
            zero *= 0
    system = CoupledSystem(np.eye(axes), np.eye(axes), gains, 0.1 * gains)
    coupled_loop = CoupledLoop(SampledCoupledSystem(system, PERIOD_S), CoupledPlant(transfers, delays, coupling))
    delayed_plants = []
    for w, z, ticks in zip(omegas, dampings, delays, strict=True):
        sampled = control.c2d(control.ss(control.tf([w**2], [1.0, 2 * z * w, w**2])), PERIOD_S, "zoh")
        delay = control.ss([], [], [], 1.0, PERIOD_S)
        if ticks:
            delay = control.ss(control.tf([1.0], [1.0] + [0.0] * ticks, PERIOD_S))
        delayed_plants.append(control.series(delay, sampled))
    plant = control.append(*delayed_plants) * control.ss([], [], [], coupling, PERIOD_S)
    return coupled_loop, control.ss(*system, PERIOD_S), plant


@pytest.mark.parametrize(("axes", "seed"), [(2, 0), (2, 1), (3, 2)])
def test_s_is_that_of_python_control(axes, seed):
    coupled_loop, controller, plant = draw_loop(axes, seed)
    identity = control.ss([], [], [], np.eye(axes), PERIOD_S)
    hz = np.geomspace(0.5, 450.0, 40)
    expected = control.feedback(identity, plant * controller)(np.exp(2j * np.pi * hz * PERIOD_S))
    np.testing.assert_allclose(coupled_loop.sensitivity(hz), np.moveaxis(expected, -1, 0), rtol=1e-6, atol=1e-9)
    expected = control.feedback(identity, controller * plant)(np.exp(2j * np.pi * hz * PERIOD_S))
    np.testing.assert_allclose(coupled_loop.command_sensitivity(hz), np.moveaxis(expected, -1, 0), rtol=1e-6, atol=1e-9)
    assert coupled_loop.is_stable
    poles = control.feedback(plant * controller, identity).poles()
    assert np.abs(coupled_loop.poles).max() == pytest.approx(np.abs(poles).max(), rel=1e-8)


@pytest.mark.parametrize(("axes", "seed"), [(2, 0), (3, 2)])
def test_a_loop_broken_alone_is_that_of_the_others_closed(axes, seed):
    """1 + l_i = 1/S_ii; the closed axis loop has the step response of that axis in the full loop."""
    coupled_loop, controller, plant = draw_loop(axes, seed)
    hz = np.geomspace(0.5, 450.0, 40)
    tracking = control.feedback(plant * controller, control.ss([], [], [], np.eye(axes), PERIOD_S))
    times_s = np.arange(300) * PERIOD_S
    for i in range(axes):
        axis_loop = coupled_loop.axis_loop(i)
        np.testing.assert_allclose(axis_loop.open(hz), 1 / coupled_loop.sensitivity(hz)[:, i, i] - 1, rtol=1e-8)
        a, b, c, _ = axis_loop.matrices
        x, response = np.zeros(b.size), []
        for _ in times_s:
            response.append(c[0] @ x)
            x = a @ x + b
        _, expected = control.step_response(tracking, times_s, input=i, output=i)
        np.testing.assert_allclose(response, expected, atol=1e-9)
        assert axis_loop.static_gain == np.inf


def largest_diagonal_gain(matrix: np.ndarray) -> float:
    """Return a lower bound of μ for diagonal complex changes: largest |eigenvalue| of U M, U diagonal and unitary."""
    count = matrix.shape[0]
    phases = np.linspace(0, 2 * np.pi, 91)
    grid = np.stack(np.meshgrid(*[phases] * (count - 1), indexing="ij"), axis=-1).reshape(-1, count - 1)
    rotations = np.exp(1j * np.hstack([np.zeros((grid.shape[0], 1)), grid]))
    return float(np.abs(np.linalg.eigvals(rotations[:, :, None] * matrix)).max())


@pytest.mark.parametrize(
    ("axes", "seed", "first_axis"),
    [
        *((2, 0, ""), (2, 1, ""), (2, 5, ""), (3, 2, ""), (3, 7, "")),
        *((2, 0, "receives"), (2, 5, "acts"), (3, 2, "receives"), (3, 2, "acts")),
    ],
)
def test_the_disk_margin_is_what_a_search_over_all_changes_finds(axes, seed, first_axis):
    coupled_loop, *_ = draw_loop(axes, seed, first_axis)
    margins = coupled_loop.margins
    hz = np.geomspace(1.0, 450.0, 300) if axes == 2 else margins.disk_margin_hz * np.geomspace(0.8, 1.25, 11)
    searched = max(largest_diagonal_gain(matrix) for matrix in coupled_loop.sensitivity(hz) - np.eye(axes) / 2)
    assert 1 / margins.disk_margin == pytest.approx(searched, rel=0.02)
    assert 1 / margins.disk_margin >= searched * (1 - 1e-3)  # the margin is not above the searched one
    expected = np.linalg.norm(coupled_loop.sensitivity(np.geomspace(1.0, 450.0, 300)), 2, axis=(1, 2)).max()
    assert margins.max_sensitivity == pytest.approx(expected, rel=0.01)


def test_gains_within_the_disk_margin_keep_it_stable():
    """Every combination of the two sensors' extreme gains within the disk margin leaves the loop stable."""
    coupled_loop, controller, plant = draw_loop(2, 1)
    margin = coupled_loop.margins.disk_margin
    for low in (0, 1):
        for high in (0, 1):
            extremes = (1 - margin / 2) / (1 + margin / 2) * 1.001, (1 + margin / 2) / (1 - margin / 2) * 0.999
            gains = control.ss([], [], [], np.diag([extremes[low], extremes[high]]), PERIOD_S)
            closed = control.feedback(gains * plant * controller, control.ss([], [], [], np.eye(2), PERIOD_S))
            assert np.abs(closed.poles()).max() < 1


def test_tustin_is_that_of_python_control():
    random = np.random.default_rng(3)
    a: Real = random.normal(size=(4, 4)) - 5 * np.eye(4)
    system = CoupledSystem(a, random.normal(size=(4, 2)), random.normal(size=(2, 4)), random.normal(size=(2, 2)))
    hz = np.array([1.0, 60.0, 300.0])
    response = tustin(system, PERIOD_S, 60.0).response(np.exp(2j * np.pi * hz * PERIOD_S))
    sampled = control.c2d(control.ss(*system), PERIOD_S, "tustin", prewarp_frequency=2 * np.pi * 60.0)
    expected = np.moveaxis(sampled(np.exp(2j * np.pi * hz * PERIOD_S)), -1, 0)
    np.testing.assert_allclose(response, expected, rtol=1e-9)
    np.testing.assert_allclose(response[1], system.response(2j * np.pi * 60.0)[0], rtol=1e-9)
    with pytest.raises(ValueError, match="between 0 and half the sampling rate"):
        tustin(system, PERIOD_S, 600.0)


def test_systems_beside_each_other_know_nothing_of_each_other():
    first = System(np.array([[0.5]]), np.array([2.0]), np.array([3.0]), 0.25)
    second = System(np.array([[0.1, 1.0], [0.0, 0.2]]), np.array([0.0, 1.0]), np.array([1.0, 0.0]), 0.0)
    response = block_diagonal_system([first, second]).response([2.0])[0]
    np.testing.assert_allclose(response, np.diag([first.response(2.0)[0], second.response(2.0)[0]]))


def test_the_coupling_of_names_as_a_matrix():
    matrix = coupling_matrix(["x", "y"], [{"y": 0.15}, {}])
    np.testing.assert_array_equal(matrix, [[1.0, 0.15], [0.0, 1.0]])
