"""Kernels unrolled to four lanes give the same bits as the plain loops that their docstrings state."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.hysteresis.play_model import MAX_PLAYS
from rtloop.kernel.layout import CONTROL
from rtloop.kernel.memory import new_records
from rtloop.laws.shipped.lanes import BLOCK, LANES
from rtloop.laws.shipped.prandtl_ishlinskii import move_and_sum_plays, plays_sum
from rtloop.laws.shipped.transfer import COEFFICIENTS, MAX_ORDER, STATE, command

RNG = np.random.default_rng(4)


def play(value: float, threshold: float, last: float) -> float:
    """Return the next output of a play operator, F⁺ = max(value − r, min(value + r, F))."""
    return max(value - threshold, min(value + threshold, last))


def sum_in_lanes(terms: list[float], lanes: int = LANES) -> float:
    """Return the sum of the terms: four partial sums, term by term, which are added in pairs."""
    sums = [0.0] * lanes
    for i, term in enumerate(terms):
        sums[i % lanes] += term
    return (sums[0] + sums[1]) + (sums[2] + sums[3])


@pytest.mark.parametrize("count", range(0, MAX_PLAYS + 1, LANES))
@pytest.mark.parametrize("kernel", [plays_sum, move_and_sum_plays])
def test_sums_of_plays(kernel, count):
    thresholds, weights = np.sort(RNG.uniform(0, 8, MAX_PLAYS)), RNG.normal(0, 3, MAX_PLAYS)
    for _ in range(20):
        plays, value = RNG.normal(0, 4, MAX_PLAYS), float(RNG.normal(0, 6))
        expected = [play(value, float(thresholds[i]), float(plays[i])) for i in range(count)]
        result, expected_plays = kernel(value, thresholds, weights, plays, count, np.zeros(LANES)), plays.copy()
        assert result == sum_in_lanes([float(weights[i]) * expected[i] for i in range(count)])
        if kernel is move_and_sum_plays:
            expected_plays[:count] = expected
        assert plays.tobytes() == expected_plays.tobytes()


@pytest.mark.parametrize("order", range(0, MAX_ORDER + 1, BLOCK))
def test_the_controllers_output(order):
    coefficients, state, control = new_records(COEFFICIENTS, 1), new_records(STATE, 1), new_records(CONTROL, 1)
    for _ in range(20):
        c, x, error, direct = RNG.normal(size=MAX_ORDER), RNG.normal(size=MAX_ORDER), *RNG.normal(size=2)
        coefficients[0].c, coefficients[0].d, coefficients[0].order = c, direct, order
        state[0].controller, control[0].error_um = x, error
        firsts = [i for i in range(order) if i % BLOCK < LANES]
        terms = [float(c[i]) * float(x[i]) + float(c[i + LANES]) * float(x[i + LANES]) for i in firsts]
        assert command(coefficients[0], state[0], control[0]) == sum_in_lanes(terms) + float(direct) * float(error)
