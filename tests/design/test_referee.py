"""Margins, norms, sampling and reduction of the paper's and random systems, compared with python-control and SLICOT.

`test_hinf` compares γ of the synthesis with SLICOT.
"""

import control
import numpy as np
import pytest

from rtloop.analysis.closed_loop import continuous_loop, discrete_loop
from rtloop.analysis.margins import loop_margins
from rtloop.design.interchange import from_control, to_control
from rtloop.design.paper import PAPER_C, PAPER_D
from rtloop.design.synthesis.hinf.augment import Matrices, augment
from rtloop.design.synthesis.hinf.norm import hinf_norm
from rtloop.design.synthesis.hinf.solver import synthesise_hinf
from rtloop.design.synthesis.reduce import reduce_order
from rtloop.design.synthesis.weights import PAPER_WEIGHTS
from rtloop.linear.discretise import discretise_controller, discretise_transfer
from rtloop.linear.transfer import Transfer

PERIOD_S = 1e-4
ONE = control.ss([], [], [], [[1.0]])


def random_system(seed: int, **kind: bool) -> control.StateSpace:
    """Return a stable random system of 2 to 8 states."""
    np.random.seed(seed)  # python-control draws from numpy's own stream
    return control.rss(2 + seed % 7, **kind)


def control_margins(system: control.StateSpace) -> tuple[float, float, float, float]:
    """Return python-control's lowest crossover (Hz), least phase margin (°), least gain margin > 1, and max |S|."""
    gains, phases, moduli, _, crossovers, _ = control.stability_margins(system, returnall=True)
    return (
        min(crossovers, default=np.nan) / (2 * np.pi),
        np.min(np.abs(phases), initial=np.inf),
        min(gains[gains > 1], default=np.inf),
        1 / min(moduli, default=np.inf),
    )


def rtloop_margins(loop) -> tuple[float, float, float, float]:
    """Return the figures of `control_margins`, computed by rtloop."""
    margins = loop_margins(loop)
    return margins.crossover_hz, margins.phase_margin_deg, margins.gain_margin, margins.max_sensitivity


def test_the_papers_margins() -> None:
    loop = continuous_loop(PAPER_C, PAPER_D)
    assert rtloop_margins(loop) == pytest.approx(control_margins(to_control(loop)), rel=1e-9)


@pytest.mark.parametrize("delay_ticks", [0, 1, 3])
def test_the_papers_margins_as_it_runs(delay_ticks) -> None:
    """python-control interpolates on a grid of frequencies here: its polynomials in z are too inaccurate."""
    loop = discrete_loop(discretise_controller(PAPER_C, PERIOD_S), PAPER_D, delay_ticks)
    grid = control.frd(to_control(loop), np.geomspace(100.0, 5000.0, 3000))
    assert rtloop_margins(loop) == pytest.approx(control_margins(grid), rel=2e-5)


@pytest.mark.parametrize("seed", range(20))
def test_margins_of_random_loops(seed) -> None:
    controller, plant = from_control(random_system(seed)), from_control(random_system(seed + 100, strictly_proper=True))
    loop = continuous_loop(controller, plant)
    crossover, phase, gain, peak = control_margins(to_control(controller) * to_control(plant))
    assert rtloop_margins(loop)[3] >= (1 - 1e-9) * peak  # python-control omits minima of |1 + L| at the ends
    assert rtloop_margins(loop)[:3] == pytest.approx((crossover, phase, gain), rel=1e-6, nan_ok=True)


@pytest.mark.parametrize("seed", range(20))
def test_norms_of_random_systems(seed) -> None:
    """The oracle is SLICOT's AB13DD, with a tolerance of ten digits."""
    system = random_system(seed)
    norm = hinf_norm(Matrices(system.A, system.B, system.C, system.D)).norm
    assert norm == pytest.approx(control.linfnorm(system)[0], rel=5e-6)


def test_the_norm_of_the_papers_sensitivity() -> None:
    loop = continuous_loop(PAPER_C, PAPER_D)
    norm, omega = control.linfnorm(control.feedback(ONE, to_control(loop)))
    assert norm == pytest.approx(1.66854, abs=1e-5)
    assert loop_margins(loop).max_sensitivity == pytest.approx(norm, rel=1e-9)
    assert loop_margins(loop).max_sensitivity_hz == pytest.approx(omega / (2 * np.pi), rel=1e-4)


@pytest.mark.parametrize("seed", [None, *range(20)])
def test_zero_order_hold(seed) -> None:
    """python-control samples state space here; from expanded polynomials its error on eq (5) is 0.01 to 2 %."""
    plant = PAPER_D if seed is None else from_control(random_system(seed, strictly_proper=True))
    period_s = PERIOD_S if seed is None else 0.05
    expected = control.c2d(to_control(plant), period_s, "zoh")
    z = np.exp(2j * np.pi * np.geomspace(1e-4, 0.49, 200))
    assert discretise_transfer(plant, period_s, "zoh").system.response(z) == pytest.approx(expected(z), rel=1e-10)


@pytest.mark.parametrize(("method", "control_method"), [("truncate", "truncate"), ("residualise", "matchdc")])
def test_reduction_of_the_papers_controller_to_order_5(method, control_method) -> None:
    controller = synthesise_hinf(augment(PAPER_D, PAPER_WEIGHTS)).controller
    full = Transfer.from_state_space(controller.a, controller.b, controller.c, controller.d)
    expected = control.balred(to_control(full), 5, method=control_method)
    s = 2j * np.pi * np.geomspace(0.01, 2e4, 400)
    assert reduce_order(full, 5, method).transfer.response(s) == pytest.approx(expected(s), rel=1e-10)
