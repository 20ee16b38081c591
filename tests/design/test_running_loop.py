"""The discretised loop with taps, sections and delay, at and between ticks, compared with simulation in small steps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import linalg, signal

from rtloop.analysis.closed_loop import Loop, discrete_loop
from rtloop.analysis.coupled_loop import CoupledLoop, CoupledPlant
from rtloop.analysis.held_plant import POINTS
from rtloop.analysis.reference import ReferencePath
from rtloop.analysis.step_response import step_metrics, step_response
from rtloop.linear.coupled_systems import CoupledSystem, SampledCoupledSystem
from rtloop.linear.discretise import discretise_controller
from rtloop.linear.realisation import System
from rtloop.linear.sampled import SampledController
from rtloop.linear.transfer import Transfer

PERIOD_S, OMEGA, ZETA, KI, KP = 1e-3, 2 * np.pi * 90.0, 0.1, 30.0, 0.05
PLANT = Transfer.from_factors(OMEGA**2, [], [[1.0, 2 * ZETA * OMEGA, OMEGA**2]])
TAPS, COMMAND_TAPS = np.array([0.2, 0.5, 0.0, 0.25]), np.array([0.7, -0.4, 0.0, 0.0, 0.1])
SECTION = [0.2, 0.1, 0.05, -0.9, 0.25]
TICKS = 500


def controller() -> SampledController:
    """Return the controller v = KP e + KI T Σ e, with the sum up to the tick before."""
    return SampledController(System(np.eye(1), np.ones(1), np.array([KI * PERIOD_S]), KP), PERIOD_S)


def simulate_step(
    delay_ticks: int, path: tuple[np.ndarray, np.ndarray, list[float] | None], plants: int = 1, cross: float = 0.0
):
    """Return positions (POINTS·TICKS,) and commands (TICKS,) of axis 0 after its unit step, by expm of T/POINTS.

    With two `plants`, the input of each has `cross` times the other's command added; both loops are closed.
    """
    a = np.array([[0.0, 1.0], [-(OMEGA**2), -2 * ZETA * OMEGA]])
    exponential = linalg.expm(np.block([[a, np.array([[0.0], [OMEGA**2]])], [np.zeros((1, 3))]]) * PERIOD_S / POINTS)
    taps, command_taps, section = path
    step = np.ones(TICKS)
    filtered = signal.lfilter(taps, 1.0, step)
    if section is not None:
        filtered = signal.lfilter(section[:3], [1.0, *section[3:]], filtered)
    feedforward = signal.lfilter(command_taps, 1.0, step) if command_taps.size else 0 * step
    states, sums = np.zeros((plants, 2)), np.zeros(plants)
    queues = [[0.0] * delay_ticks for _ in range(plants)]
    positions, commands = [], []
    for k in range(TICKS):
        errors = np.array([filtered[k] if i == 0 else 0.0 for i in range(plants)]) - states[:, 0]
        v = KP * errors + KI * PERIOD_S * sums
        v[0] += feedforward[k]
        sums += errors
        commands.append(v[0])
        inputs = v + cross * (v.sum() - v) if plants > 1 else v
        for i in range(plants):
            queues[i].append(inputs[i])
        delayed = np.array([queue.pop(0) for queue in queues])
        for _ in range(POINTS):
            positions.append(states[0, 0])
            states = states @ exponential[:2, :2].T + np.outer(delayed, exponential[:2, 2])
    return np.array(positions), np.array(commands)


PATHS = [
    (np.ones(1), np.empty(0), None),
    (TAPS, np.empty(0), SECTION),
    (TAPS, COMMAND_TAPS, None),
    (TAPS, COMMAND_TAPS, SECTION),
]


def reference_path(taps: np.ndarray, command_taps: np.ndarray, section: list[float] | None) -> ReferencePath:
    """Return the reference path with one second-order section, or none."""
    return ReferencePath(taps, command_taps, np.array([section] if section else []).reshape(-1, 5))


@pytest.mark.parametrize("delay_ticks", [0, 1, 3])
@pytest.mark.parametrize("path", PATHS)
def test_steps_of_the_loop_as_it_runs(path, delay_ticks: int) -> None:
    loop = discrete_loop(controller(), PLANT, delay_ticks, reference_path(*path))
    assert loop.is_stable
    positions, commands = simulate_step(delay_ticks, path)
    response = step_response(loop, (TICKS - 1) * PERIOD_S)
    np.testing.assert_allclose(response.position, positions, atol=1e-11)
    np.testing.assert_allclose(response.command[::POINTS], commands, atol=1e-11)
    np.testing.assert_allclose(response.time_s, np.arange(TICKS * POINTS) * PERIOD_S / POINTS, atol=1e-12)


@pytest.mark.parametrize("delay_ticks", [0, 2])
@pytest.mark.parametrize("path", PATHS)
def test_steps_of_one_of_two_coupled_axes(path, delay_ticks: int) -> None:
    cross = 0.2
    single = controller().system
    coupled = CoupledSystem(np.eye(2), np.eye(2), KI * PERIOD_S * np.eye(2), KP * np.eye(2))
    assert single.d == coupled.d[0, 0]
    plant = CoupledPlant((PLANT, PLANT), (delay_ticks,) * 2, np.array([[1.0, cross], [cross, 1.0]]))
    loop = CoupledLoop(SampledCoupledSystem(coupled, PERIOD_S), plant).axis_loop(0, reference_path(*path))
    assert loop.is_stable
    positions, commands = simulate_step(delay_ticks, path, 2, cross)
    response = step_response(loop, (TICKS - 1) * PERIOD_S)
    np.testing.assert_allclose(response.position, positions, atol=1e-11)
    np.testing.assert_allclose(response.command[::POINTS], commands, atol=1e-11)


def test_sections_of_finite_memory_settle_after_two_ticks_each() -> None:
    """Three taps and two sections without poles: the response to a step stands still from the sixth tick on."""
    section = [0.5, 0.3, 0.2, 0.0, 0.0]
    path = ReferencePath(np.array([0.5, 0.3, 0.2]), sections=np.array([section, section]))
    step = path.error_input(np.ones(40))
    assert np.flatnonzero(np.abs(step - 1) > 1e-12)[-1] == 5
    assert 6 <= path.settling_ticks <= 8


def loop_with_path(path) -> Loop:
    """Return the loop with one sample of delay and a reference path."""
    return discrete_loop(controller(), PLANT, 1, reference_path(*path))


@pytest.mark.parametrize("path", PATHS)
def test_figures_of_a_step_are_those_between_ticks(path) -> None:
    """The path to the error alone decides the final value where the controller integrates.

    Where the final value is more than 5 % from the reference there is neither overshoot nor settling time.
    """
    positions, commands = simulate_step(1, path)
    taps, _, section = path
    final = taps.sum() * (1.0 if section is None else sum(section[:3]) / (1 + sum(section[3:])))
    metrics = step_metrics(loop_with_path(path), ())
    assert metrics.static_error_percent == pytest.approx(100 * abs(1 - final), abs=1e-8)
    assert metrics.peak_command == pytest.approx(np.abs(commands).max(), abs=1e-6)
    if abs(1 - final) > 0.05:
        assert np.isnan([metrics.overshoot_percent, metrics.settling_time_s]).all()
        return
    assert metrics.overshoot_percent == pytest.approx(100 * max(0.0, positions.max() / final - 1), abs=1e-3)
    last = np.flatnonzero(np.abs(positions - final) > 0.05 * final)[-1]
    assert metrics.settling_time_s == pytest.approx((last + 0.5) * PERIOD_S / POINTS, abs=0.51 * PERIOD_S / POINTS)


def test_without_an_integrator_the_command_path_moves_the_final_value() -> None:
    """P-control, K = 2, of D(0) = 1: x = (K F_x + F_v)/(1 + K)."""
    controller = discretise_controller(Transfer.from_zpk([], [], 2.0), PERIOD_S)
    loop = discrete_loop(controller, Transfer.from_zpk([], [-50.0], 50.0), 0,
                         ReferencePath(np.array([0.5, 0.4]), np.array([0.9, 0.2])))  # fmt: skip
    assert loop.final_values == pytest.approx(((2 * 0.9 + 1.1) / 3, 2 * (0.9 - (2 * 0.9 + 1.1) / 3) + 1.1))
    assert step_metrics(loop, ()).static_error_percent == pytest.approx(100 * abs(1 - 2.9 / 3))


@pytest.mark.parametrize("path", PATHS)
def test_responses_to_the_reference_are_those_of_its_step(path) -> None:
    """The oracle is the z-transform of the differences of the step response."""
    loop, hz = loop_with_path(path), np.array([1.0, 30.0, 88.0, 300.0])
    positions, commands = simulate_step(1, path)
    ticks = TICKS + 1  # by then the transient is far below the tolerance
    exponentials = np.exp(-2j * np.pi * hz[:, None] * PERIOD_S * np.arange(ticks - 1))
    position, command = loop.response_from_reference(hz)
    for response, step_values, final in (
        (position, positions[::POINTS], loop.final_values[0]),
        (command, commands, loop.final_values[1]),
    ):
        assert abs(step_values[-1] - final) < 1e-3
        np.testing.assert_allclose(response, (np.diff(step_values, prepend=0.0) * exponentials).sum(axis=1), atol=5e-3)
