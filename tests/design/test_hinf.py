"""The Glover-Doyle solver against the paper's γ, closed forms and, if installed, SLICOT; errors name their cause."""

import math
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtloop.design.paper import PAPER_D
from rtloop.design.synthesis.hinf.assumptions import NoController
from rtloop.design.synthesis.hinf.augment import GeneralisedPlant, Matrices, augment
from rtloop.design.synthesis.hinf.norm import hinf_norm
from rtloop.design.synthesis.hinf.solver import synthesise_hinf
from rtloop.design.synthesis.weights import PAPER_WEIGHTS
from rtloop.linear.transfer import Transfer
from tests.design.plants import dense_norm, hamiltonian_norm, random_plant

NORMALISED_D = Transfer(PAPER_D.zeros, PAPER_D.poles, PAPER_D.gain / PAPER_D.dc_gain)


@pytest.mark.parametrize(("plant", "gamma_opt"), [(PAPER_D, 1.6761), (NORMALISED_D, 1.6802)])
def test_the_papers_problem(plant, gamma_opt) -> None:
    """γ_opt of eqs (5), (15), (17), (19), recomputed independently; the controller has order 11, as the paper says."""
    standard = augment(plant, PAPER_WEIGHTS)
    solution = synthesise_hinf(standard)
    assert solution.gamma_opt == pytest.approx(gamma_opt, abs=2e-3)
    assert solution.gamma == pytest.approx(1.004 * solution.gamma_opt)
    assert solution.controller.a.shape == (11, 11)
    assert solution.limiting.startswith("coupling")
    loop = standard.close_loop(solution.controller)
    for norm in (dense_norm(*loop), hamiltonian_norm(*loop)):
        assert norm <= 1.002 * solution.gamma
        assert norm == pytest.approx(solution.achieved, rel=1e-4)


def scalar_plant(a: float) -> GeneralisedPlant:
    """Return x' = a x + w1 + u, z = (x, u), y = x + w2 (Doyle, Glover, Khargonekar & Francis 1989, one state)."""
    unit = np.ones((1, 1))
    return GeneralisedPlant(
        a * unit, np.array([[1.0, 0.0]]), unit, np.array([[1.0], [0.0]]), unit,
        np.zeros((2, 2)), np.array([[0.0], [1.0]]), np.array([[0.0, 1.0]]), 0 * unit,
    )  # fmt: skip


@pytest.mark.parametrize("a", [-30.0, -1.0, 0.0, 0.5, 4.0])
def test_a_scalar_plant_in_closed_form(a) -> None:
    """X = Y = 1/(√(a² + 1 − γ⁻²) − a), and X·Y = γ² at γ_opt: γ_opt = a + √(a² + 2)."""
    solution = synthesise_hinf(scalar_plant(a))
    assert solution.gamma_opt == pytest.approx(a + math.sqrt(a * a + 2), rel=1e-6)
    assert dense_norm(*scalar_plant(a).close_loop(solution.controller)) <= 1.002 * solution.gamma


def test_the_zero_on_the_right_bounds_the_sensitivity() -> None:
    """min ‖W1 S‖∞ = |W1(z)| for a zero z on the right, if commands have almost no weight (Zames & Francis 1983)."""
    plant = Transfer.from_zpk([20.0], [-5.0, -40.0], -1.0)
    w1 = Transfer.from_zpk([-9.0], [-0.01], 0.5)
    augmented = augment(plant, PAPER_WEIGHTS._replace(
        tracking=w1, command=Transfer.from_zpk([], [], 1e-5), disturbance=Transfer.from_zpk([], [], 0.0)
    ))  # fmt: skip
    assert synthesise_hinf(augmented).gamma_opt == pytest.approx(0.5 * 29 / 20.01, rel=1e-3)


@pytest.mark.parametrize("seed", [0, 1, 2, 4, 5, 6, 8, 13, 23, 29, 30])
def test_random_plants_keep_their_promise(seed) -> None:
    """Two independent norms of the loop stay below γ, with D11 and D22 not zero and unstable modes."""
    plant = random_plant(seed)
    solution = synthesise_hinf(plant)
    loop = plant.close_loop(solution.controller)
    assert dense_norm(*loop) <= 1.002 * solution.gamma
    assert hamiltonian_norm(*loop) <= 1.002 * solution.gamma


def run_slicot(plant: GeneralisedPlant, start: float) -> tuple[float, Matrices]:
    """Return γ and the controller by SLICOT's SB10AD; skip the test where slycot is not installed."""
    slycot = pytest.importorskip("slycot")
    m2, p2 = plant.b2.shape[1], plant.c2.shape[0]
    b, c = np.hstack([plant.b1, plant.b2]), np.vstack([plant.c1, plant.c2])
    d = np.block([[plant.d11, plant.d12], [plant.d21, np.zeros((p2, m2))]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # slycot warns of rounding close to γ_opt
        gamma, *controller = slycot.sb10ad(
            len(plant.a), b.shape[1], c.shape[0], m2, p2, start, plant.a, b, c, d, job=1
        )[:5]
    return gamma, Matrices(*controller)


@pytest.mark.parametrize("seed", [0, 1, 4, 6, 7, 9, 14, 16, 18, 19, 25, 27])
def test_random_plants_as_slicot(seed) -> None:
    """γ_opt of SLICOT's SB10AD, for orders 2 to 20."""
    plant = random_plant(seed)
    solution = synthesise_hinf(plant)
    gamma, controller = run_slicot(plant, 2 * solution.gamma_opt)
    bare = plant._replace(d22=0 * plant.d22)
    assert dense_norm(*bare.close_loop(controller)) <= 1.001 * gamma  # SLICOT keeps its own γ for these plants
    assert solution.gamma_opt == pytest.approx(gamma, rel=1e-4)


@pytest.mark.parametrize("seed", [5, 8, 13, 28])
def test_where_slicot_promises_too_much(seed) -> None:
    """SB10AD's controller misses SB10AD's γ, because its bisection steps over a limit set by a Riccati equation."""
    plant = random_plant(seed)
    solution = synthesise_hinf(plant)
    gamma, controller = run_slicot(plant, 2 * solution.gamma_opt)
    slicot_norm = dense_norm(*plant._replace(d22=0 * plant.d22).close_loop(controller))
    assert slicot_norm > 1.1 * gamma
    assert gamma < solution.gamma_opt <= slicot_norm * (1 + 1e-4)


@pytest.mark.parametrize("plant", [PAPER_D, NORMALISED_D])
def test_the_papers_problem_as_slicot(plant) -> None:
    standard = augment(plant, PAPER_WEIGHTS)
    solution = synthesise_hinf(standard)
    assert solution.gamma_opt == pytest.approx(run_slicot(standard, 2 * solution.gamma_opt)[0], rel=1e-4)


def variant(**parts) -> GeneralisedPlant:
    """Return the scalar plant with a = 1 and the given matrices replaced."""
    return scalar_plant(1.0)._replace(**{name: np.array(value, dtype=float) for name, value in parts.items()})


INTEGRATING = PAPER_WEIGHTS._replace(tracking=Transfer.from_zpk([-1000.0], [0.0], 1.0))


@pytest.mark.parametrize(
    ("plant", "gamma", "message"),
    [
        (variant(b2=[[0]]), None, r"stabilisability: the command u does not move the mode at s = 1 rad/s"),
        (variant(c2=[[0]]), None, r"detectability: the measurement y does not show the mode at s = 1 rad/s"),
        (variant(d12=[[0], [0]]), None, r"rank: D12 has rank 0 of 1.*full column rank. Give every command u a weight"),
        (
            variant(d21=[[0, 0]]),
            None,
            r"rank: D21 has rank 0 of 1.*full row rank. Give every measurement y a disturbance",
        ),
        (variant(b2=[[0]], c2=[[0]]), None, r"stabilisability.*; detectability"),
        (scalar_plant(0.0)._replace(c1=np.zeros((2, 1))), None, r"zero: the path from u to z .* ω = 0 rad/s"),
        (scalar_plant(0.0)._replace(b1=np.zeros((1, 2))), None, r"zero: the path from w to y .* ω = 0 rad/s"),
        (scalar_plant(0.0), 1.2, "coupling"),
        (scalar_plant(0.0), 0.9, "Riccati equation of the state feedback"),
        (
            scalar_plant(0.0)._replace(d11=np.array([[2.0, 0.0], [0.0, 0.0]])),
            1.9,
            "above 2, the norm of the part of D11",
        ),
        (
            augment(PAPER_D, PAPER_WEIGHTS),
            1.676,
            r"gamma: 1.676 cannot be reached; allowed: at least 1.676.*\. coupling",
        ),
        (augment(PAPER_D, INTEGRATING), None, "detectability: the measurement y does not show the mode at s = 0 rad/s"),
    ],
)
def test_the_condition_that_fails_is_named(plant, gamma, message) -> None:
    """γ None searches for the least γ. In the last case a weight integrates the error, a mode that y does not show."""
    with pytest.raises(NoController, match=message):
        synthesise_hinf(plant, gamma=gamma)


def test_an_error_that_the_command_can_cancel_directly_has_a_controller() -> None:
    plant = variant(c1=[[1], [1]], d12=[[1], [1]], d11=[[0, 0], [0, 0]])
    assert synthesise_hinf(plant).achieved < math.inf


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000), st.floats(-3, 3))
def test_the_norm_is_that_of_a_dense_grid(seed, exponent) -> None:
    plant = random_plant(seed)
    stable = plant.a - (max(np.linalg.eigvals(plant.a).real.max(), 0) + 10**exponent) * np.eye(len(plant.a))
    system = Matrices(stable, plant.b1, plant.c1, plant.d11)
    assert hinf_norm(system).norm == pytest.approx(dense_norm(*system), rel=1e-5)


def test_the_norm_of_an_undamped_and_of_a_narrow_resonance() -> None:
    """1/(s² + 2ζs + 1) has 1/(2ζ√(1 − ζ²)); an unstable system has no norm."""
    for damping in (1e-2, 1e-5):
        system = Matrices(
            np.array([[0.0, 1.0], [-1.0, -2 * damping]]), np.array([[0.0], [1.0]]), np.eye(2)[:1], np.zeros((1, 1))
        )
        assert hinf_norm(system).norm == pytest.approx(1 / (2 * damping * math.sqrt(1 - damping**2)), rel=1e-5)
    assert hinf_norm(system._replace(a=-system.a)).norm == math.inf
