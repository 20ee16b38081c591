"""Functions of matrices and grids agree with scipy and numpy, which use other algorithms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag, expm, solve_discrete_lyapunov

from rtloop.foundation.arrays import rising_grid
from rtloop.linear.matrices import block_diagonal, matrix_exponential, stationary_covariance


@pytest.mark.parametrize("size", [1, 2, 5, 13])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 300.0])
def test_an_exponential_is_that_of_scipy(size: int, scale: float):
    numbers = np.random.default_rng(size)
    matrix = scale * (numbers.normal(size=(size, size)) - 2 * size * np.eye(size))
    expected = expm(matrix)
    assert np.allclose(matrix_exponential(matrix), expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())


def test_an_exponential_of_a_nilpotent_matrix_with_a_large_entry_is_exact():
    """e^[[0, b], [0, 0]] = [[1, b], [0, 1]]; squaring as often as the norm asks for would lose digits."""
    assert np.array_equal(matrix_exponential(np.array([[0.0, 1e12], [0.0, 0.0]])), [[1.0, 1e12], [0.0, 1.0]])


def test_an_exponential_of_one_number_is_that_of_the_library():
    for number in (0.0, 1e-9, -1.0, 20.0, -700.0):
        assert matrix_exponential(np.array([[number]]))[0, 0] == pytest.approx(np.exp(number), rel=1e-12)


@pytest.mark.parametrize("radius", [0.0, 0.5, 0.999, 1 - 1e-6])
def test_a_stationary_covariance_is_that_of_scipy(radius: float):
    numbers = np.random.default_rng(3)
    a = numbers.normal(size=(6, 6))
    a *= radius / np.abs(np.linalg.eigvals(a)).max()
    inputs = numbers.normal(size=(6, 2))
    expected = solve_discrete_lyapunov(a, inputs @ inputs.T, method="direct")
    assert np.allclose(stationary_covariance(a, inputs @ inputs.T), expected, rtol=1e-8, atol=1e-9 * expected.max())


def test_a_first_order_filter_has_the_variance_of_a_geometric_series():
    assert stationary_covariance(np.array([[0.8]]), np.array([[1.0]]))[0, 0] == pytest.approx(1 / (1 - 0.64), rel=1e-14)


def test_blocks_stand_along_the_diagonal():
    blocks = [np.arange(4.0).reshape(2, 2) + 1, np.empty((0, 0)), np.array([[7.0]])]
    assert np.array_equal(block_diagonal(blocks), np.asarray(block_diag(*[block for block in blocks if block.size])))


@pytest.mark.parametrize("parts", [[[3.0, 1.0], [2.0, 1.0]], [[5.0]], [[], [0.0, -0.0, 1.0]], [[]]])
def test_a_rising_grid_has_each_number_once(parts: list[list[float]]):
    assert np.array_equal(rising_grid([np.array(part) for part in parts]), np.unique(np.concatenate(parts)))
