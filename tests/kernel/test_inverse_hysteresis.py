"""The inverse compensation against a model in numpy: the paper's numbers, and a memory that survives limited drives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtloop.drivers.base import Channel
from rtloop.signals import Flag, Mode
from tests.kernel.harness import EXACT, LawBench, make_coefficients
from tests.kernel.oracle import G, Hysteresis, P, R, Z, sine

FORMULA = make_coefficients()
PRINTED = make_coefficients(feedforward={"inverse_thresholds_um": Z, "inverse_weights_v_per_um": G})
DEAD_BAND = make_coefficients(feedforward=EXACT, limits={"command_um": 100.0})
SLEWED = make_coefficients(feedforward=EXACT, limits={"command_um": 100.0, "slew_v_per_s": 2000.0})
SETTLED = 6000
"""Ticks after which the offset of a change of mode is gone: 0.02 s · ln(80 µm / 1e-9 µm) = 0.5 s."""


def test_numbers_on_the_initial_curve():
    """Inverse of eq (4) by formula: u(40 µm) = 9.44932 V. Its model of the applied command: y(10 V) = 43.01835 µm."""
    assert LawBench(FORMULA, Mode.FEEDFORWARD).run([40.0]).drive_v[0] == pytest.approx(9.44932, abs=1e-5)
    assert LawBench(DEAD_BAND, Mode.RAW).run([10.0]).applied_um[0] == pytest.approx(43.01835, abs=1e-5)


@pytest.mark.parametrize(
    ("coefficients", "residual_um", "tolerance_um"),
    [
        pytest.param(FORMULA, 0.7471, 1e-3, id="formula of eq (4), its dead band r_0 = 0.095 V left"),
        pytest.param(PRINTED, 2.918, 5e-3, id="eq (6) as printed"),
        pytest.param(DEAD_BAND, 0.0, 1e-12, id="exact dead band"),
    ],
)
def test_residual_of_a_40_um_sine(coefficients, residual_um, tolerance_um):
    """The residual is max |P[P̂⁻¹[v]] − v| from rest, with P of eq (4)."""
    command = sine(40.0)
    signals = LawBench(coefficients, Mode.FEEDFORWARD).run(command)
    assert not np.any(signals.flags)
    residual = np.abs(Hysteresis().run(signals.drive_v) - command).max()
    assert residual == pytest.approx(residual_um, abs=tolerance_um)


def random_walk(seed: int, ticks: int, reach: float) -> np.ndarray:
    """Return a random walk of shape (ticks,) within ±reach."""
    walk = np.cumsum(np.random.default_rng(seed).normal(0, reach / 6, ticks))
    return np.abs((walk + reach) % (4 * reach) - 2 * reach) - reach


def run_clipped(bench: LawBench) -> list[np.ndarray]:
    """Run commands beyond the drive's limit; return the drives (V)."""
    signals = bench.run(sine(80.0, 2001), mode=Mode.FEEDFORWARD)
    assert np.any(signals.flags.astype(int) & Flag.DRIVE_LIMITED)
    return [signals.drive_v]


def run_raw(bench: LawBench) -> list[np.ndarray]:
    """Run random raw drives; return the drives (V)."""
    return [bench.run(random_walk(3, 2000, 9.9), mode=Mode.RAW).drive_v]


def run_tripped(bench: LawBench) -> list[np.ndarray]:
    """Run a sine, then 40 ticks of a trip's ramp; return the drives (V) of both parts."""
    first = bench.run(sine(35.0, 1001, 1.3), mode=Mode.FEEDFORWARD)
    ramp = bench.run(np.zeros(40), 9.995)
    assert int(ramp.flags[-1]) & Flag.TRIP_SENSOR_RANGE
    assert 0 < abs(ramp.drive_v[-1]) < abs(first.drive_v[-1])
    return [first.drive_v, ramp.drive_v]


@pytest.mark.parametrize("disturb", [run_clipped, run_raw, run_tripped])
@pytest.mark.parametrize("coefficients", [DEAD_BAND, SLEWED], ids=["no slew", "slew"])
def test_memory_survives(disturb, coefficients):
    """The applied command is P̂[u] of the drive u in every tick, and later commands are reached exactly."""
    bench, oracle = LawBench(coefficients), Hysteresis()
    for drives in disturb(bench):
        last_um = oracle.run(drives)[-1]
    assert bench.axes.applied_command_um[0] == pytest.approx(last_um, abs=1e-12)
    settling = bench.run(np.full(SETTLED, 17.0), mode=Mode.FEEDFORWARD, reset=True)
    np.testing.assert_allclose(settling.applied_um, oracle.run(settling.drive_v), rtol=0, atol=1e-12)
    command = 17.0 + sine(22.0, 9001, 3.0)
    signals = bench.run(command)
    unlimited = signals.flags == 0
    assert np.sum(~unlimited) <= (7 if coefficients is SLEWED else 0)  # a reversal's jump of 2 r_0 may exceed the slew
    np.testing.assert_allclose(oracle.run(signals.drive_v)[unlimited], command[unlimited], rtol=0, atol=1e-12)


def test_slewed_commands_are_known_too():
    signals = LawBench(SLEWED, Mode.FEEDFORWARD).run(np.repeat([30.0, -30.0, 12.0, -3.0], 30))
    assert np.any(signals.flags.astype(int) & Flag.SLEW_LIMITED)
    np.testing.assert_allclose(signals.applied_um, Hysteresis().run(signals.drive_v), rtol=0, atol=1e-12)


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=30), st.lists(st.floats(-41, 41), min_size=1, max_size=30))
@settings(deadline=None)
def test_any_past_then_any_commands(drives, commands):
    """Commands are met after random raw drives, which leave any possible memory.

    A command that turns the drive by less than the dead band's threshold, 1e-12 V, may be missed by that much.
    """
    bench, oracle = LawBench(DEAD_BAND, Mode.RAW), Hysteresis()
    oracle.run(bench.run(drives).drive_v)
    bench.loops.mode[0] = Mode.FEEDFORWARD  # without the offset of a bumpless change
    signals = bench.run(commands)
    np.testing.assert_allclose(signals.applied_um, oracle.run(signals.drive_v), rtol=0, atol=1e-12)
    np.testing.assert_allclose(signals.applied_um, commands, rtol=0, atol=1e-11)


def random_model(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return thresholds and weights of a random invertible model: partial sums of weights are positive."""
    rng = np.random.default_rng(seed)
    sums = rng.uniform(0.3, 8.0, rng.integers(1, 20))
    return np.cumsum(rng.uniform(1e-3, 0.8, sums.size)), np.diff(sums, prepend=0.0)


@pytest.mark.parametrize("seed", range(20))
def test_any_model_that_inverts(seed):
    """P[P̂⁻¹[v]] = v within rounding, for random thresholds and weights."""
    thresholds, weights = random_model(seed)
    feedforward = {
        "thresholds_v": thresholds.tolist(),
        "weights_um_per_v": weights.tolist(),
        "dead_band": "exact",
        "dead_band_threshold_v": 1e-12,
    }
    limits = {"drive_v": 1e4, "command_um": 1e4, "trip_slew_v_per_s": 1e5}
    coefficients = make_coefficients(Channel("wide", -1e5, 1e5), feedforward=feedforward, limits=limits)
    command = random_walk(seed, 3000, 30.0)
    signals = LawBench(coefficients, Mode.FEEDFORWARD).run(command)
    assert not np.any(signals.flags)
    np.testing.assert_allclose(Hysteresis(thresholds, weights).run(signals.drive_v), command, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("feedforward", "message"),
    [
        ({"thresholds_v": [0.0, 1.0], "weights_um_per_v": [1.0, -1.0]}, "allowed: every partial sum above 0"),
        ({"thresholds_v": [0.5, 0.2], "weights_um_per_v": [1.0, 1.0]}, "allowed: ascending numbers, 0 or more"),
        ({"thresholds_v": [0.5], "weights_um_per_v": [1.0, 1.0]}, "1 thresholds and 2 weights"),
        ({"inverse_thresholds_um": [0.1], "inverse_weights_v_per_um": [1.0]}, "the first is 0.1 µm; allowed: 0"),
        ({}, "either thresholds_v with weights_um_per_v"),
        ({"thresholds_v": list(R), "weights_um_per_v": list(P), "inverse_thresholds_um": [0.0]}, "either thresholds_v"),
    ],
)
def test_models_that_cannot_be(feedforward, message):
    with pytest.raises(ValueError, match=message):
        make_coefficients(feedforward=feedforward)
