"""The drive is finite and keeps its limit and slew rates for any input; a NaN does not change the memory."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtloop.signals import Flag, Mode
from tests.kernel.harness import EQ_20, EXACT, PERIOD_S, LawBench, Signals, make_coefficients

DRIVE_V, SLEW, TRIP_SLEW = 10.0, 0.7, 0.1
ULPS_V = 8 * np.spacing(DRIVE_V)
FULL = make_coefficients(
    controller=EQ_20,
    feedforward=EXACT,
    prefilter={"taps": [0.5, 0.3, 0.2], "sections": [[0.02, 0.04, 0.02, -1.5, 0.58]]},
    limits={"slew_v_per_s": SLEW / PERIOD_S, "trip_slew_v_per_s": TRIP_SLEW / PERIOD_S},
)
WILD = [math.nan, math.inf, -math.inf, 1e308, -1e308, 1e9, -1e9, 9.99, -9.99, 5e-324, -0.0, 0.0]

values = st.one_of(st.sampled_from(WILD), st.floats(-12, 12), st.floats())
ticks = st.tuples(
    values,
    values,
    st.sampled_from([-1, -1, *Mode]),
    st.booleans(),
    st.sampled_from([0, 0, 0, 1, -1]),
    st.sampled_from([0.0, 0.0, 1e6, math.nan]),
    st.sampled_from([0, 0, 0, 1]),
)


def check_drive(signals: Signals, last_v: float = 0.0) -> None:
    """Assert that the drive, which was `last_v` before, is finite and keeps its limit and the slew rate of its mode."""
    assert np.all(np.isfinite(signals.drive_v))
    assert np.all(np.abs(signals.drive_v) <= DRIVE_V)
    steps_v = np.abs(np.diff(signals.drive_v, prepend=last_v))
    running = signals.mode != Mode.OFF
    assert np.all(steps_v[running] <= SLEW + ULPS_V)
    assert np.all(steps_v[~running] <= TRIP_SLEW + ULPS_V)


@given(st.lists(ticks, min_size=1, max_size=60))
@settings(deadline=None, max_examples=300)
def test_any_inputs(steps):
    adc_v, references, modes, resets, status, age_us, lost = zip(*steps, strict=True)
    bench = LawBench(FULL, Mode.CLOSED_LOOP)
    inputs = {"modes": modes, "resets": resets, "status": status, "age_us": age_us, "lost": lost}
    check_drive(bench.run(references, adc_v, **inputs))
    assert bench.is_finite()


@pytest.mark.parametrize("mode", [Mode.RAW, Mode.FEEDFORWARD, Mode.CLOSED_LOOP])
def test_square_waves_at_the_resonance(mode):
    """The drive keeps its limits for full scale at 595.5 Hz, where ±10 V would move the cantilever by 376 µm."""
    square = np.sign(np.sin(2 * np.pi * 595.5 * PERIOD_S * np.arange(20000) + 0.1))
    unslewed = make_coefficients(controller=EQ_20, feedforward=EXACT)
    for coefficients in (FULL, unslewed):
        signals = LawBench(coefficients, mode).run(1e6 * square, 5.0 * square)
        assert np.all(np.abs(signals.drive_v) <= DRIVE_V)
        assert np.max(np.abs(signals.drive_v)) > 1.0
        if coefficients is FULL:
            check_drive(signals)


POISONS = {
    "adc NaN": {"adc_v": math.nan},
    "adc inf": {"adc_v": math.inf},
    "adc 1e308": {"adc_v": -1e308},
    "reference NaN": {"references": math.nan},
    "reference -inf": {"references": -math.inf},
    "both": {"adc_v": math.nan, "references": math.nan},
}


@pytest.mark.parametrize("mode", [Mode.RAW, Mode.FEEDFORWARD, Mode.CLOSED_LOOP])
@pytest.mark.parametrize("poison", POISONS.values(), ids=POISONS.keys())
def test_a_nan_leaves_no_state_behind(poison, mode):
    """The tick holds the drive, trips, and changes no memory; the law then runs as if the tick had not been."""
    poisoned, spared = LawBench(FULL, mode), LawBench(FULL, mode)
    rng = np.random.default_rng(5)
    references, adc_v = rng.normal(0, 3, 500), rng.normal(0, 0.3, 500)
    last = [bench.run(references, adc_v).drive_v[-1] for bench in (poisoned, spared)]
    before = poisoned.memory()
    tick = poisoned.run(poison.get("references", 1.0), poison.get("adc_v", 0.1))
    assert poisoned.memory() == before
    assert tick.drive_v[0] == last[0]
    assert tick.mode[0] == Mode.OFF
    assert int(tick.flags[0]) & Flag.TRIP_NON_FINITE
    after = [bench.run(references, adc_v, reset=True, mode=mode) for bench in (poisoned, spared)]
    assert after[0].drive_v.tobytes() == after[1].drive_v.tobytes()
    assert poisoned.state_bytes() == spared.state_bytes()


def test_a_lasting_nan_ramps_down():
    bench = LawBench(FULL, Mode.RAW)
    bench.run(np.full(20, 5.0))
    signals = bench.run(np.full(100, math.nan), math.nan)
    assert signals.drive_v[0] == 5.0
    np.testing.assert_allclose(signals.drive_v[1:51], 5.0 - TRIP_SLEW * np.arange(1, 51), rtol=0, atol=1e-13)
    assert np.all(signals.drive_v[51:] == 0.0)


@pytest.mark.parametrize(
    ("inputs", "cause"),
    [
        ({"adc_v": 9.995}, Flag.TRIP_SENSOR_RANGE),
        ({"adc_v": -9.995}, Flag.TRIP_SENSOR_RANGE),
        ({"adc_v": 6.01}, Flag.TRIP_POSITION),
        ({"adc_v": -6.01}, Flag.TRIP_POSITION),
        ({"status": -1}, Flag.TRIP_DRIVER),
        ({"lost": 1}, Flag.TRIP_HEARTBEAT),
        ({"age_us": 1000.1}, Flag.TRIP_STALE),
        ({"age_us": math.nan}, Flag.TRIP_STALE),
    ],
)
def test_each_cause_trips_and_stays(inputs, cause):
    bench = LawBench(FULL, Mode.RAW)
    assert bench.run(np.full(10, 3.0), 5.99, age_us=1000.0, status=1).flags[-1] == 0
    assert int(bench.run(3.0, **inputs).flags[0]) & cause
    after_cause = bench.run(np.full(50, 3.0))
    assert np.all(after_cause.flags.astype(int) & cause)
    assert np.all(after_cause.mode == Mode.OFF)
    assert after_cause.drive_v[-1] == 0.0
    assert bench.run(3.0, reset=True, mode=Mode.RAW).flags[0] == 0
