"""Loops of several axes against python-control, and the disk margin against a search over changes."""

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


def loop(axes: int, seed: int) -> tuple[CoupledLoop, control.StateSpace, control.StateSpace]:
    """Integrators behind second-order plants that move each other; C and G for python-control, too."""
    random = np.random.default_rng(seed)
    omegas, dampings = random.uniform(60, 200, axes), random.uniform(0.1, 0.8, axes)
    transfers = tuple(
        Transfer.from_transfer_function([w**2], [1.0, 2 * z * w, w**2]) for w, z in zip(omegas, dampings, strict=True)
    )
    coupling = np.eye(axes) + 0.2 * random.uniform(-1, 1, (axes, axes)) * (1 - np.eye(axes))
    delays = tuple(int(ticks) for ticks in random.integers(0, 3, axes))
    gains = 10.0 * PERIOD_S * (np.eye(axes) + 0.2 * random.uniform(-1, 1, (axes, axes)))
    system = CoupledSystem(np.eye(axes), np.eye(axes), gains, 0.1 * gains)
    found = CoupledLoop(SampledCoupledSystem(system, PERIOD_S), CoupledPlant(transfers, delays, coupling))
    own = []
    for w, z, ticks in zip(omegas, dampings, delays, strict=True):
        held = control.c2d(control.ss(control.tf([w**2], [1.0, 2 * z * w, w**2])), PERIOD_S, "zoh")
        late = control.ss([], [], [], 1.0, PERIOD_S)
        if ticks:
            late = control.ss(control.tf([1.0], [1.0] + [0.0] * ticks, PERIOD_S))
        own.append(control.series(late, held))
    plant = control.append(*own) * control.ss([], [], [], coupling, PERIOD_S)
    return found, control.ss(*system, PERIOD_S), plant


@pytest.mark.parametrize(("axes", "seed"), [(2, 0), (2, 1), (3, 2)])
def test_s_is_that_of_python_control(axes, seed):
    found, controller, plant = loop(axes, seed)
    one = control.ss([], [], [], np.eye(axes), PERIOD_S)
    hz = np.geomspace(0.5, 450.0, 40)
    expected = control.feedback(one, plant * controller)(np.exp(2j * np.pi * hz * PERIOD_S))
    np.testing.assert_allclose(found.sensitivity(hz), np.moveaxis(expected, -1, 0), rtol=1e-6, atol=1e-9)
    expected = control.feedback(one, controller * plant)(np.exp(2j * np.pi * hz * PERIOD_S))
    np.testing.assert_allclose(found.command_sensitivity(hz), np.moveaxis(expected, -1, 0), rtol=1e-6, atol=1e-9)
    assert found.is_stable
    poles = control.feedback(plant * controller, one).poles()
    assert np.abs(found.poles).max() == pytest.approx(np.abs(poles).max(), rel=1e-8)


@pytest.mark.parametrize(("axes", "seed"), [(2, 0), (3, 2)])
def test_a_loop_broken_alone_is_that_of_the_others_closed(axes, seed):
    """1 + l_i = 1/S_ii; closed again it is the whole loop, whose step response is the axis's own."""
    found, controller, plant = loop(axes, seed)
    hz = np.geomspace(0.5, 450.0, 40)
    tracking = control.feedback(plant * controller, control.ss([], [], [], np.eye(axes), PERIOD_S))
    times_s = np.arange(300) * PERIOD_S
    for i in range(axes):
        own = found.axis_loop(i)
        np.testing.assert_allclose(own.open(hz), 1 / found.sensitivity(hz)[:, i, i] - 1, rtol=1e-8)
        a, b, c, _ = own.matrices
        x, response = np.zeros(b.size), []
        for _ in times_s:
            response.append(c[0] @ x)
            x = a @ x + b
        _, expected = control.step_response(tracking, times_s, input=i, output=i)
        np.testing.assert_allclose(response, expected, atol=1e-9)
        assert own.static_gain == np.inf


def structured(matrix: np.ndarray) -> float:
    """μ for a diagonal of complex numbers, from below: the largest |eigenvalue| of U M over unitary diagonals U."""
    count = matrix.shape[0]
    phases = np.linspace(0, 2 * np.pi, 91)
    grid = np.stack(np.meshgrid(*[phases] * (count - 1), indexing="ij"), axis=-1).reshape(-1, count - 1)
    turns = np.exp(1j * np.hstack([np.zeros((grid.shape[0], 1)), grid]))
    return float(np.abs(np.linalg.eigvals(turns[:, :, None] * matrix)).max())


@pytest.mark.parametrize(("axes", "seed"), [(2, 0), (2, 1), (2, 5), (3, 2), (3, 7)])
def test_the_disk_margin_is_what_a_search_over_all_changes_finds(axes, seed):
    found, *_ = loop(axes, seed)
    margins = found.margins
    hz = np.geomspace(1.0, 450.0, 300) if axes == 2 else margins.disk_margin_hz * np.geomspace(0.8, 1.25, 11)
    searched = max(structured(matrix) for matrix in found.sensitivity(hz) - np.eye(axes) / 2)
    assert 1 / margins.disk_margin == pytest.approx(searched, rel=0.02)
    assert 1 / margins.disk_margin >= searched * (1 - 1e-3)  # never promised more than there is
    expected = np.linalg.norm(found.sensitivity(np.geomspace(1.0, 450.0, 300)), 2, axis=(1, 2)).max()
    assert margins.max_sensitivity == pytest.approx(expected, rel=0.01)


def test_gains_within_the_disk_margin_keep_it_stable():
    """And a change of one sensor's gain beyond its own gain margin does not."""
    found, controller, plant = loop(2, 1)
    disk = found.margins.disk_margin
    for low in (0, 1):
        for high in (0, 1):
            ends = (1 - disk / 2) / (1 + disk / 2) * 1.001, (1 + disk / 2) / (1 - disk / 2) * 0.999
            gains = control.ss([], [], [], np.diag([ends[low], ends[high]]), PERIOD_S)
            closed = control.feedback(gains * plant * controller, control.ss([], [], [], np.eye(2), PERIOD_S))
            assert np.abs(closed.poles()).max() < 1


def test_tustin_is_that_of_python_control():
    random = np.random.default_rng(3)
    a: Real = random.normal(size=(4, 4)) - 5 * np.eye(4)
    system = CoupledSystem(a, random.normal(size=(4, 2)), random.normal(size=(2, 4)), random.normal(size=(2, 2)))
    hz = np.array([1.0, 60.0, 300.0])
    found = tustin(system, PERIOD_S, 60.0).response(np.exp(2j * np.pi * hz * PERIOD_S))
    sampled = control.c2d(control.ss(*system), PERIOD_S, "tustin", prewarp_frequency=2 * np.pi * 60.0)
    expected = np.moveaxis(sampled(np.exp(2j * np.pi * hz * PERIOD_S)), -1, 0)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    np.testing.assert_allclose(found[1], system.response(2j * np.pi * 60.0)[0], rtol=1e-9)
    with pytest.raises(ValueError, match="between 0 and half the sampling rate"):
        tustin(system, PERIOD_S, 600.0)


def test_systems_beside_each_other_know_nothing_of_each_other():
    one = System(np.array([[0.5]]), np.array([2.0]), np.array([3.0]), 0.25)
    two = System(np.array([[0.1, 1.0], [0.0, 0.2]]), np.array([0.0, 1.0]), np.array([1.0, 0.0]), 0.0)
    found = block_diagonal_system([one, two]).response([2.0])[0]
    np.testing.assert_allclose(found, np.diag([one.response(2.0)[0], two.response(2.0)[0]]))


def test_the_coupling_of_names_as_a_matrix():
    found = coupling_matrix(["x", "y"], [{"y": 0.15}, {}])
    np.testing.assert_array_equal(found, [[1.0, 0.15], [0.0, 1.0]])
