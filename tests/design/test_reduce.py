"""Balanced reduction against 50-digit arithmetic, closed forms and Glover's error bound."""

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtloop.design.paper import PAPER_C, PAPER_D
from rtloop.design.synthesis.reduce import hankel_singular_values, order_within, reduce_order
from rtloop.linear.transfer import Transfer

RNG = np.random.default_rng(20)
PAIRS = [complex(-(10 ** RNG.uniform(-3, -0.3)) * w, w) for w in np.geomspace(5, 5e4, 8)]
ORDER_20 = Transfer.from_zpk(
    [-3.0, -7e3, *(1.05 * p for p in PAIRS), *(1.05 * p.conjugate() for p in PAIRS)],
    [-1.0, -40.0, -2e3, -1e5, *PAIRS, *(p.conjugate() for p in PAIRS)],
    1e6,
)
FAR_APART = Transfer.from_zpk([-2.0, -5e4], [-1.0, -1.001, -1e5, -1.0001e5], 3.0)
SYSTEMS = {"eq 5": PAPER_D, "eq 20": PAPER_C, "order 20": ORDER_20, "far apart": FAR_APART}


def balanced_50_digits(transfer: Transfer):
    """Return a balanced a, b, c, d and the Hankel singular values, from residues and modal Gramians at 50 digits."""
    mp.mp.dps = 50
    zeros, poles = ([mp.mpc(complex(root)) for root in roots] for roots in (transfer.zeros, transfer.poles))
    n = len(poles)
    residues = []
    for i, pole in enumerate(poles):
        value = mp.mpf(transfer.gain)
        for zero in zeros:
            value *= pole - zero
        for j, other_pole in enumerate(poles):
            value /= pole - other_pole if i != j else 1
        residues.append(value)
    p = mp.matrix(n, n)
    q = mp.matrix(n, n)
    for i in range(n):
        for j in range(n):
            p[i, j] = -1 / (poles[i] + mp.conj(poles[j]))
            q[i, j] = -mp.conj(residues[i]) * residues[j] / (mp.conj(poles[i]) + poles[j])
    values, vectors = mp.eig(p * q)
    falling = sorted(range(n), key=lambda i: -values[i].real)
    transformation = mp.matrix(n, n)
    for column, i in enumerate(falling):
        for row in range(n):
            transformation[row, column] = vectors[row, i]
    inverse = transformation**-1
    a = inverse * mp.diag(poles) * transformation
    b = inverse * mp.matrix([1] * n)
    c = mp.matrix([residues]) * transformation
    hankel = [float(mp.sqrt(abs(values[i].real))) for i in falling]
    return a, b, c, mp.mpf(transfer.high_frequency_gain), np.array(hankel)


def response_50_digits(parts, keep: int, method: str, s: complex) -> complex:
    """Return the truncated or residualised system's response at `s`; balancing up to scales of the states is enough."""
    a, b, c, d, _ = parts
    n = a.rows
    system = mp.mpc(s) * mp.eye(n) - a
    if method == "residualise":
        for i in range(keep, n):
            system[i, i] -= mp.mpc(s)
        return complex(d + (c * mp.lu_solve(system, b))[0])
    return complex(d + (c[:, :keep] * mp.lu_solve(system[:keep, :keep], b[:keep, :]))[0])


@pytest.mark.parametrize("name", SYSTEMS)
def test_hankel_singular_values_and_reduction_at_50_digits(name) -> None:
    """Relative accuracy of each value above 1e-13 of the largest, and of the reduced response over all frequencies."""
    transfer = SYSTEMS[name]
    parts = balanced_50_digits(transfer)
    computed, exact = hankel_singular_values(transfer), parts[-1]
    count = int(np.sum(exact > 1e-13 * exact[0]))
    assert computed.size >= count
    assert np.max(np.abs(computed[:count] - exact[:count])) < 1e-12 * exact[0]
    assert computed[:count] == pytest.approx(exact[:count], rel=1e-6)
    gaps = np.flatnonzero(exact[:-1] > 1.05 * exact[1:]) + 1
    keep = int(gaps[len(gaps) // 2])
    points = 1j * np.geomspace(1e-2, 1e7, 12)
    for method in ("residualise", "truncate"):
        reduced = reduce_order(transfer, keep, method).transfer
        expected = np.array([response_50_digits(parts, keep, method, s) for s in points])
        assert np.max(np.abs(reduced.response(points) - expected)) < 1e-6 * np.max(np.abs(expected))


def test_a_lag_has_half_its_gain() -> None:
    """σ of k/(τs + 1) is k/2, and a reduction to the same order keeps pole and gain."""
    lag = Transfer.from_factors(6.0, [], [[0.25, 1.0]])
    assert hankel_singular_values(lag) == pytest.approx([3.0], rel=1e-14)
    same = reduce_order(lag, 1).transfer
    assert (same.poles[0], same.gain) == (pytest.approx(-4.0), pytest.approx(24.0))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 8), st.sampled_from(["residualise", "truncate"]))
def test_glovers_bound_and_what_each_method_keeps(seed, keep, method) -> None:
    rng = np.random.default_rng(seed)
    poles = -(10 ** rng.uniform(0, 3, 8))
    transfer = Transfer.from_zpk(-(10 ** rng.uniform(0, 3, 8)), poles, rng.uniform(0.1, 10))
    require_glovers_bound(transfer, keep, method)


def random_roots(rng: np.random.Generator, count: int) -> list[complex]:
    """Return roots of a stable real system over five decades, about half of them in pairs with light damping."""
    roots: list[complex] = []
    while len(roots) < count:
        size, damping = 10 ** rng.uniform(-1, 4), rng.uniform(0.01, 0.9)
        root = size * complex(-damping, np.sqrt(1 - damping**2))
        roots += [root, root.conjugate()] if rng.random() < 0.5 and count - len(roots) > 1 else [complex(-size)]
    return roots


@pytest.mark.parametrize("seed", range(30))
def test_glovers_bound_for_strictly_proper_systems_of_high_order(seed) -> None:
    rng = np.random.default_rng(seed)
    order = int(rng.integers(9, 13))
    transfer = Transfer.from_zpk(random_roots(rng, int(rng.integers(0, order))), random_roots(rng, order), 1.0)
    for keep in range(1, order):
        require_glovers_bound(transfer, keep, "residualise")


def require_glovers_bound(transfer: Transfer, keep: int, method: str) -> None:
    """Require of a reduction that its error is within Glover's bound, and that it keeps the gain it is to keep."""
    reduced = reduce_order(transfer, keep, method)
    s = 1j * np.concatenate([[0.0], np.geomspace(1e-3, 1e8, 300), np.abs(transfer.poles)])
    error = np.abs(reduced.transfer.response(s) - transfer.response(s))
    size = np.abs(transfer.response(s)).max()
    assert error.max() <= reduced.error_bound + 1e-6 * size
    if method == "residualise":
        assert error[0] < 1e-6 * size
    else:
        assert reduced.transfer.high_frequency_gain == pytest.approx(transfer.gain, rel=1e-9)
    assert reduced.transfer.is_stable


def test_the_order_follows_from_the_tolerance() -> None:
    hankel = np.array([10.0, 1.0, 0.1, 0.01])
    assert [order_within(hankel, t) for t in (1.0, 0.2, 0.01, 1e-3, 1e-4, 0.0)] == [0, 1, 2, 3, 4, 4]
    assert reduce_order(PAPER_D, tolerance=0.5).transfer.order < reduce_order(PAPER_D, tolerance=1e-3).transfer.order


def test_modes_that_are_not_stable_stay() -> None:
    transfer = Transfer.from_zpk([-3.0, -50.0], [0.0, 4.0, -10.0, -1e3], 2.0)
    reduced = reduce_order(transfer, 3).transfer
    assert np.sort(reduced.poles.real)[-2:] == pytest.approx([0.0, 4.0], abs=1e-12)
    with pytest.raises(ValueError, match=r"order: 1; .* 2 modes that are not stable: 2 to 4"):
        reduce_order(transfer, 1)


def test_repeated_poles_are_reduced_through_lyapunov_equations() -> None:
    """The oracle for 1/(s + 1)³ is σ at 50 digits for poles that are 1e-4 apart."""
    triple = Transfer.from_factors(1.0, [], [[1, 1], [1, 1], [1, 1]])
    separated = Transfer.from_zpk([], [-1.0, -1.0 - 1e-4, -1.0 + 1e-4], 1.0)
    assert hankel_singular_values(triple) == pytest.approx(balanced_50_digits(separated)[-1], rel=1e-3)
    with pytest.raises(ValueError, match="cannot be reduced"):
        reduce_order(Transfer.from_factors(1.0, [], [[1, -1], [1, -1], [1, 3]]), 2)
