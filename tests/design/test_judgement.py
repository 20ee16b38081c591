"""Required limits and the figures that they limit, on loops with closed-form answers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rtloop.analysis.closed_loop import continuous_loop, discrete_loop
from rtloop.analysis.margins import loop_margins
from rtloop.design.synthesis.specification import (
    CommandOptions,
    DisturbanceOptions,
    SensorOptions,
    SpecificationOptions,
)
from rtloop.design.verification.judgement import loop_quantities, required_limits, specified_quantities
from rtloop.design.verification.robustness import tolerated_shift, worst_values
from rtloop.linear.discretise import discretise_controller
from rtloop.linear.transfer import Transfer

PERIOD_S, POLE, GAIN = 1e-3, 200.0, 3.0
PLANT = Transfer.from_zpk([], [-POLE], POLE)
PROPORTIONAL = Transfer.from_zpk([], [], GAIN)


@pytest.mark.parametrize(
    ("specification", "name", "accepted", "rejected"),
    [
        (SpecificationOptions(overshoot_percent=5.0), "overshoot_percent", 4.0, 6.0),
        (SpecificationOptions(static_error_percent=0.1), "static_error_percent", 0.05, 0.2),
        (SpecificationOptions(settling_ms=3.0), "settling_ms", 2.0, 4.0),
        (SpecificationOptions(bandwidth_hz=50.0), "bandwidth_hz", 60.0, 40.0),
        (SpecificationOptions(modulus_margin=0.5), "modulus_margin", 0.6, 0.4),
        (SpecificationOptions(resonance_decay_ms=1.5), "resonance_decay_ms", 1.0, 2.0),
        (SpecificationOptions(resonance_shift_percent=5.0), "resonance_shift_percent", 6.0, 4.0),
        (SpecificationOptions(command=CommandOptions(reference_um=20.0, command_um=22.0)), "peak_command", 1.0, 1.2),
        (SpecificationOptions(disturbance=DisturbanceOptions(largest_um=1.0, error_um=0.1, up_to_hz=5.0)),
         "disturbance_hz", 6.0, 4.0),
        (SpecificationOptions(disturbance=DisturbanceOptions(largest_um=1.0, error_um=0.1)),
         "disturbance_hz", math.inf, 1e6),
    ],
)  # fmt: skip
def test_a_limit_has_a_direction(
    specification: SpecificationOptions, name: str, accepted: float, rejected: float
) -> None:
    ((quantity, limit),) = required_limits(specification).items()
    assert quantity == name
    assert limit.accepts(accepted)
    assert limit.accepts(limit.value)
    assert not limit.accepts(rejected)
    assert not limit.accepts(math.nan)


OMEGA, ZETA = 2 * math.pi * 90.0, 0.02
RESONANT = Transfer.from_factors(OMEGA**2, [], [[1.0, 2 * ZETA * OMEGA, OMEGA**2]])


def test_the_slowest_mode_near_the_resonance_in_closed_form() -> None:
    """P-control K of ω²/(s² + 2ζωs + ω²) leaves −ζω and moves the frequency to ω√(1 + K): near up to 1.85 ω."""
    for gain, decay_ms in ((0.5, 1e3 / (ZETA * OMEGA)), (2.3, 1e3 / (ZETA * OMEGA)), (2.6, 0.0)):
        loop = continuous_loop(Transfer.from_zpk([], [], gain), RESONANT)
        values = specified_quantities(loop, SpecificationOptions(), OMEGA)
        assert values["resonance_decay_ms"] == pytest.approx(decay_ms)
    assert "resonance_decay_ms" not in specified_quantities(loop, SpecificationOptions())


def test_the_modulus_margin_is_the_least_distance_from_minus_one() -> None:
    """The oracle is |1 + L| of L = K/(s(τs + 1)) on a dense grid."""
    loop = continuous_loop(Transfer.from_factors(80.0, [], [[1, 0]]), Transfer.from_factors(1, [], [[0.01, 1]]))
    s = 1j * np.geomspace(1, 1e4, 200_001)
    distance = np.abs(1 + 80.0 / (s * (0.01 * s + 1))).min()
    assert specified_quantities(loop, SpecificationOptions(modulus_margin=0.5))["modulus_margin"] == pytest.approx(
        distance
    )


def test_the_worst_of_several_plants_is_named() -> None:
    """A lag under integral control: twice the gain overshoots most and has the most bandwidth, half is the slowest."""
    controller = discretise_controller(Transfer.from_factors(60.0, [], [[1, 0]]), PERIOD_S)
    plants = [(name, Transfer(PLANT.zeros, PLANT.poles, factor * PLANT.gain), 0)
              for name, factor in (("as it is", 1.0), ("twice", 2.0), ("half", 0.5))]  # fmt: skip
    worst_values_by_name = worst_values(
        lambda plant, ticks: discrete_loop(controller, plant, ticks), plants, SpecificationOptions(), None
    )
    assert worst_values_by_name["overshoot_percent"].plant == "twice"
    assert worst_values_by_name["bandwidth_hz"].plant == "half"
    assert worst_values_by_name["settling_ms"].plant == "half"
    assert worst_values_by_name["settling_ms"].value == pytest.approx(1e3 * 3 / 30, rel=0.2)
    plants_with_unstable = [*plants, ("wild", Transfer(PLANT.zeros, PLANT.poles, 100 * PLANT.gain), 0)]
    worst_values_by_name = worst_values(
        lambda plant, ticks: discrete_loop(controller, plant, ticks), plants_with_unstable, SpecificationOptions(), None
    )
    assert {value.plant for value in worst_values_by_name.values()} == {"wild"}
    assert all(math.isnan(value.value) for value in worst_values_by_name.values())


def test_the_smaller_end_of_the_shift_counts() -> None:
    """Integral control K/s of a resonance is stable while K < 2ζω′: a shift of p % with ζ kept moves that by p %."""
    gain = 0.93 * 2 * ZETA * OMEGA
    controller = Transfer.from_factors(gain, [], [[1, 0]])
    assert tolerated_shift(lambda plant: continuous_loop(controller, plant), RESONANT) == pytest.approx(7.0, abs=1e-3)
    assert tolerated_shift(lambda plant: continuous_loop(controller, plant), PLANT) == math.inf


def test_noise_of_the_sensor_in_position_and_command() -> None:
    """x⁺ = a x − b K (x + n): var x = (b K)² σ²/(1 − (a − b K)²), and v = −K (x + n) holds the noise itself."""
    sigma_nm, a = 10.0, math.exp(-POLE * PERIOD_S)
    b = 1 - a
    loop = discrete_loop(discretise_controller(PROPORTIONAL, PERIOD_S), PLANT)
    assert SensorOptions(resolution_um=0.012).deviation_um == pytest.approx(0.012 / math.sqrt(12))
    quantities = loop_quantities(loop, SensorOptions(noise_um=1e-3 * sigma_nm))
    variance_x = (b * GAIN * sigma_nm) ** 2 / (1 - (a - b * GAIN) ** 2)
    assert quantities["noise_x_nm"] == pytest.approx(math.sqrt(variance_x))
    assert quantities["noise_v_nm"] == pytest.approx(GAIN * math.sqrt(variance_x + sigma_nm**2))


@pytest.mark.parametrize("is_sampled", [False, True])
def test_a_gain_margin_may_lie_at_0_hz(is_sampled: bool) -> None:
    """L(0) = −0.4 is the nearest that L comes to −1: 2.5 times the gain, and a real pole is on its way out."""
    wrong_sign = Transfer.from_zpk([], [], -0.4)
    sampled = discrete_loop(discretise_controller(wrong_sign, PERIOD_S), PLANT)
    loop = sampled if is_sampled else continuous_loop(wrong_sign, PLANT)
    margins = loop_margins(loop)
    assert margins.gain_margin == pytest.approx(2.5)
    assert margins.gain_margin_hz == 0.0
    for gain, stable in ((0.4 * 2.49, True), (0.4 * 2.51, False)):
        assert continuous_loop(Transfer.from_zpk([], [], -gain), PLANT).is_stable is stable
    assert np.isnan(margins.crossover_hz)
