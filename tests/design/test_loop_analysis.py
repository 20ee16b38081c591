"""The paper's loop, eqs (5) and (20): golden values recomputed outside the project, and textbook loops."""

import json
import math

import numpy as np
import pytest
from scipy import linalg

from rtloop.analysis.closed_loop import continuous_loop, discrete_loop
from rtloop.analysis.held_plant import POINTS
from rtloop.analysis.loop_analysis import LoopAnalysis, analyse_loop
from rtloop.analysis.margins import delay_margin, loop_margins
from rtloop.analysis.perturbation import loop_builder, plant_changes, shift_resonance, stability_range
from rtloop.analysis.step_response import step_response
from rtloop.design.paper import PAPER_C, PAPER_D
from rtloop.linear.discretise import DiscreteController, discretise_controller
from rtloop.linear.transfer import Transfer

T = 1e-4


def analyse_continuous(*parts: Transfer) -> LoopAnalysis:
    """Return the analysis of the continuous loop of controller and plant."""
    loop = continuous_loop(*parts)
    return analyse_loop(loop, loop_margins(loop), 0)


def analyse_discrete(controller: DiscreteController, plant: Transfer, delay_ticks: int = 0) -> LoopAnalysis:
    """Return the analysis of the sampled loop of controller, plant and delay."""
    loop = discrete_loop(controller, plant, delay_ticks)
    return analyse_loop(loop, loop_margins(loop), delay_ticks)


PAPER = analyse_continuous(PAPER_C, PAPER_D)


@pytest.mark.parametrize(
    ("field", "value", "tolerance"),
    [
        ("static_error_percent", 0.166384, 1e-5),
        ("max_re_pole", -32.0636, 1e-3),
        ("max_sensitivity", 1.6685, 2e-3),
        ("crossover_hz", 94.53, 0.05),
        ("phase_margin_deg", 75.54, 0.05),
        ("gain_margin", 2.529, 5e-3),
        ("peak_command", 1.3555, 2e-3),
        ("sensitivity_1hz", 0.0105855, 1e-6),
        ("settling_time_s", 4.14e-3, 5e-6),
        ("overshoot_percent", 0.66, 5e-3),
    ],
)
def test_paper_loop_eqs_5_and_20(field, value, tolerance) -> None:
    """Continuous time, computed independently from the printed factors."""
    assert getattr(PAPER, field) == pytest.approx(value, abs=tolerance)
    assert PAPER.stable


def test_paper_step_eqs_5_and_20() -> None:
    assert PAPER.step_times_s == (0.001, 0.002, 0.003, 0.005, 0.010)
    assert PAPER.step_position == pytest.approx([0.37727, 0.6448, 0.9139, 0.99054, 0.99551], abs=2e-4)


def test_step_overshoot_of_d_eq_5() -> None:
    """14.474 % of D(0), where the text of the paper says 9.5 %. A gain of 1e-9 leaves the loop practically open."""
    response = step_response(continuous_loop(Transfer.from_zpk([], [], 1e-9), PAPER_D), 0.1)
    assert 100 * (response.position.max() / 1e-9 / 1.01086419 - 1) == pytest.approx(14.474, abs=0.02)


def test_resonance_shift_tolerated_by_the_paper() -> None:
    """Continuous: −3.9 … +2.4 %. Sampled with delay the loop is narrower upwards."""
    assert stability_range(loop_builder(PAPER_C), PAPER_D, plant_changes(PAPER_D)["resonance"]) == pytest.approx(
        (3.9, 2.4), abs=0.05
    )
    controller = discretise_controller(PAPER_C, T, "matched")
    for ticks in (0, 1, 2):
        down, up = stability_range(loop_builder(controller, ticks), PAPER_D, plant_changes(PAPER_D)["resonance"])
        assert up < 2.0
        assert down > 5.0
        assert analyse_discrete(controller, shift_resonance(PAPER_D, up - 0.01), ticks).stable
        assert not analyse_discrete(controller, shift_resonance(PAPER_D, up + 0.01), ticks).stable
        assert not analyse_discrete(controller, shift_resonance(PAPER_D, -down - 0.01), ticks).stable


@pytest.mark.parametrize(
    ("method", "prewarp_hz", "without_delay", "with_delay"),
    [
        ("matched", None, 1.640, 1.558),
        ("tustin", None, 4.894, 6.764),
        ("tustin", 595.5, 1.654, 1.561),
        ("foh", None, 1.647, 1.549),
    ],
)
def test_sensitivity_peak_as_it_runs(method, prewarp_hz, without_delay, with_delay) -> None:
    """max|S| of eqs (5) and (20) at 10 kHz with 0 and 1 samples of delay, computed independently."""
    controller = discretise_controller(PAPER_C, T, method, prewarp_hz)
    assert analyse_discrete(controller, PAPER_D, 0).max_sensitivity == pytest.approx(without_delay, abs=1e-3)
    assert analyse_discrete(controller, PAPER_D, 1).max_sensitivity == pytest.approx(with_delay, abs=1e-3)


def test_static_values_survive_sampling() -> None:
    analysis = analyse_discrete(discretise_controller(PAPER_C, T, "matched"), PAPER_D, 1)
    assert analysis.stable
    assert analysis.max_abs_pole < 1
    assert math.isnan(analysis.max_re_pole)
    assert analysis.static_error_percent == pytest.approx(0.166384, abs=1e-5)
    assert analysis.sensitivity_1hz == pytest.approx(0.0105855, abs=1e-6)


def test_discrete_step_equals_a_simulation_tick_by_tick() -> None:
    """The oracle steps the plant by scipy.linalg.expm, with the delay as a queue."""
    a, b = np.array([[0.0, 1.0], [-9e4, -40.0]]), np.array([0.0, 9e4])
    exponential = linalg.expm(np.block([[a, b[:, None]], [np.zeros((1, 3))]]) * 1e-3)
    ad, bd = exponential[:2, :2], exponential[:2, 2]
    x, integral, queue, positions, commands = np.zeros(2), 0.0, [0.0, 0.0], [], []
    for _ in range(200):
        positions.append(x[0])
        error = 1.0 - x[0]
        commands.append(2.0 * integral + 0.001 * error)  # Tustin of 2/s adds half a period of the error
        integral += 1e-3 * error
        queue.append(commands[-1])
        x = ad @ x + bd * queue.pop(0)
    loop = discrete_loop(discretise_controller(Transfer.from_factors(2, [], [[1, 0]]), 1e-3, "tustin"),
                         Transfer.from_factors(9e4, [], [[1, 40, 9e4]]), 2)  # fmt: skip
    response = step_response(loop, 0.199)
    assert response.position[::POINTS] == pytest.approx(positions, abs=1e-12)
    assert response.command[::POINTS] == pytest.approx(commands, abs=1e-12)


def test_integral_control_of_a_lag() -> None:
    """L = K/(s(τs + 1)), Kτ = 1: ζ = 0.5, overshoot exp(−πζ/√(1 − ζ²)), max|S| in closed form, no gain margin."""
    analysis = analyse_continuous(Transfer.from_factors(100, [], [[1, 0]]), Transfer.from_factors(1, [], [[0.01, 1]]))
    assert analysis.static_error_percent == 0
    assert math.isinf(analysis.gain_margin)
    assert analysis.overshoot_percent == pytest.approx(100 * math.exp(-math.pi / math.sqrt(3)), abs=1e-3)
    assert analysis.phase_margin_deg == pytest.approx(51.827, abs=1e-3)  # 90° − atan(√((√5 − 1)/2))
    u = np.linspace(0.01, 9, 900_001)
    assert analysis.max_sensitivity == pytest.approx(np.sqrt((u**2 + u) / (u**2 - u + 1)).max(), rel=1e-8)
    assert json.loads(json.dumps(analysis.as_dict(), allow_nan=False))["gain_margin"] is None


def test_gain_margin_of_three_lags() -> None:
    """(s + 1)⁻³ has its phase crossover at √3 rad/s and |L| = 1/8 there; repeated poles, so a cascade."""
    plant = Transfer.from_factors(1, [], [[1, 1], [1, 1], [1, 1]])
    analysis = analyse_continuous(Transfer.from_zpk([], [], 2.0), plant)
    assert analysis.gain_margin == pytest.approx(4.0, rel=1e-9)
    assert analysis.gain_margin_hz == pytest.approx(math.sqrt(3) / 2 / math.pi, rel=1e-9)
    assert not analyse_continuous(Transfer.from_zpk([], [], 8.1), plant).stable


def test_gain_margin_of_a_conditionally_stable_loop() -> None:
    """k (s + 1)²/s³/(1 + s/10)² is real where ω² − 9 ω + 10 = 0: beyond −1 at the slower one, within at the faster."""
    w = (9 + math.sqrt(41)) / 2
    gain = (1 + w**2) / (w**3 * (1 + w**2 / 100))
    analysis = analyse_continuous(
        Transfer.from_factors(3.0, [[1, 1], [1, 1]], [[1, 0], [1, 0]]),
        Transfer.from_factors(100.0, [], [[1, 0], [1, 10], [1, 10]]),
    )
    assert analysis.stable
    assert analysis.gain_margin == pytest.approx(1 / (3.0 * gain), rel=1e-9)
    assert analysis.gain_margin_hz == pytest.approx(w / (2 * math.pi), rel=1e-9)


def test_gain_margin_at_half_the_sampling_rate() -> None:
    """x⁺ = x + k T e is stable for k T < 2, and reaches −1 at z = −1."""
    integrator = Transfer.from_factors(1, [], [[1, 0]])
    analysis = analyse_discrete(discretise_controller(Transfer.from_zpk([], [], 500.0), 1e-3), integrator)
    assert analysis.gain_margin == pytest.approx(4.0)
    assert analysis.gain_margin_hz == pytest.approx(500)
    assert analysis.max_abs_pole == pytest.approx(0.5)


def test_unstable_loop_is_reported_not_raised() -> None:
    analysis = analyse_continuous(PAPER_C, shift_resonance(PAPER_D, 5.0))
    assert not analysis.stable
    assert analysis.max_re_pole > 0
    assert math.isnan(analysis.settling_time_s)
    assert math.isnan(analysis.peak_command)
    assert json.loads(json.dumps(analysis.as_dict(), allow_nan=False))["settling_time_s"] is None
    shifted = shift_resonance(PAPER_D, 5.0)
    assert stability_range(loop_builder(PAPER_C), shifted, plant_changes(shifted)["resonance"]) == (0.0, 0.0)


def test_undamped_plant_can_be_looked_at() -> None:
    """The poles of an undamped resonance lie on the imaginary axis, where the plant has no finite response."""
    plant = Transfer.from_factors(1e6, [], [[1, 0, 1e6]])
    analysis = analyse_continuous(Transfer.from_factors(0.2, [[1, 0]], [[1, 500]]), plant)
    assert analysis.stable
    assert math.isfinite(analysis.max_sensitivity)


def test_shifted_resonance_keeps_damping_and_static_gain() -> None:
    shifted = shift_resonance(PAPER_D, 2.0)
    assert shifted.dc_gain == pytest.approx(PAPER_D.dc_gain)
    sizes = np.abs(PAPER_D.poles)
    lightest = np.argmin(np.abs(PAPER_D.poles + 27.5 - 3741.5j))
    assert np.min(np.abs(shifted.poles - 1.02 * PAPER_D.poles[lightest])) < 1e-9 * sizes[lightest]
    with pytest.raises(ValueError, match="all poles are real"):
        shift_resonance(Transfer.from_zpk([], [-1], 1), 1.0)


def test_delay_margin_of_an_integrator() -> None:
    """L = ω_c/s has a phase margin of 90° at ω_c; a delay of a quarter period of ω_c uses it up."""
    loop = continuous_loop(Transfer.from_zpk([], [0.0], 400.0), Transfer.from_zpk([], [-1e7], 1e7))
    assert delay_margin(loop) == pytest.approx((np.pi / 2 / 400.0, 400.0 / (2 * np.pi)), rel=1e-3)


def test_a_step_without_a_duration_is_as_long_as_ten_time_constants_of_the_slowest_pole() -> None:
    loop = continuous_loop(Transfer.from_zpk([], [0.0], 400.0), Transfer.from_zpk([], [-1e7], 1e7))
    assert step_response(loop).time_s[-1] == pytest.approx(10 / 400.0, rel=1e-3)


def test_refusals() -> None:
    with pytest.raises(ValueError, match="direct feedthrough"):
        analyse_continuous(PAPER_C, PAPER_C)
    with pytest.raises(ValueError, match="delay_ticks: -1"):
        analyse_discrete(discretise_controller(PAPER_C, T), PAPER_D, -1)
