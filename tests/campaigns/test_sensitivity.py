"""Sensitivity indices against the analytic indices of Ishigami's function."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.campaigns.samples import block_size, unit_samples
from rtloop.campaigns.sensitivity import sensitivity_indices

KEYS = ("a", "b", "c")
A, B = 7.0, 0.1
VARIANCE = A**2 / 8 + B * np.pi**4 / 5 + B**2 * np.pi**8 / 18 + 0.5
FIRST = np.array([0.5 * (1 + B * np.pi**4 / 5) ** 2, A**2 / 8, 0.0]) / VARIANCE
INTERACTION = 8 * B**2 * np.pi**8 / 225 / VARIANCE
TOTAL = FIRST + np.array([INTERACTION, 0.0, INTERACTION])
"""Indices of Ishigami's function (Ishigami and Homma 1990), from its analytic variances."""


def ishigami(shares: np.ndarray) -> np.ndarray:
    """Return Ishigami's function of three numbers uniform in ±π, drawn as shares in (0, 1)."""
    x, y, z = (np.pi * (2 * shares - 1)).T
    return np.sin(x) + A * np.sin(y) ** 2 + B * z**4 * np.sin(x)


def test_the_indices_of_ishigamis_function_lie_in_their_intervals():
    """At least 54 of 60 indices (ten designs) lie in their 95 % intervals. Key c has an effect by interaction only."""
    rigs, covered = 1024 * block_size(3), 0
    for seed in range(10):
        indices = sensitivity_indices(ishigami(unit_samples("saltelli", KEYS, 0, rigs, rigs, seed)), KEYS)
        for key, first, total in zip(KEYS, FIRST, TOTAL, strict=True):
            index = indices[key]
            covered += index.first_low <= first <= index.first_high
            covered += index.total_low <= total <= index.total_high
            assert (index.first, index.total) == pytest.approx((first, total), abs=0.05)
    assert covered >= 54


def test_the_design_has_each_key_of_b_in_a_row_of_a():
    first, second, *mixed = unit_samples("saltelli", KEYS, 5 * block_size(3), block_size(3), 1000, 3)
    for number, row in enumerate(mixed):
        assert row[number] == second[number]
        assert np.array_equal(np.delete(row, number), np.delete(first, number))


def test_a_half_block_is_left_out_and_without_variance_there_is_no_index():
    figures = ishigami(unit_samples("saltelli", KEYS, 0, 323, 323, 3))
    assert [i.first for i in sensitivity_indices(figures, KEYS).values()] == [
        i.first for i in sensitivity_indices(figures[:320], KEYS).values()
    ]
    constant = sensitivity_indices(np.ones(640), KEYS)
    infinite = sensitivity_indices(np.append(np.inf, np.arange(639.0)), KEYS)
    too_few = sensitivity_indices(np.arange(5.0), KEYS)
    for indices in (constant, infinite, too_few):
        assert all(np.isnan(value) for index in indices.values() for value in index)
