"""2.5 million ticks of each of five laws with random, wild inputs; each tick is checked."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.foundation.native.compiled import jit
from rtloop.kernel.access import axis_state, loop_state
from rtloop.kernel.access import coefficients_record as axis_coefficients
from rtloop.kernel.layout import CONDITIONS
from rtloop.kernel.memory import new_records
from rtloop.kernel.step import evaluate, reset_trip, set_mode, update
from rtloop.signals import Mode
from tests.kernel.harness import EQ_20, EXACT, PERIOD_S, LawBench, make_coefficients

TICKS_EACH = 2_500_000
SLEW, TRIP_SLEW = 2.0, 0.05
LIMITED = {"slew_v_per_s": SLEW / PERIOD_S, "trip_slew_v_per_s": TRIP_SLEW / PERIOD_S, "drive_v": 9.5}
LAWS = {
    "formula": make_coefficients(controller=EQ_20, limits=LIMITED),
    "dead band": make_coefficients(controller=EQ_20, feedforward=EXACT, limits=LIMITED),
    "filtered": make_coefficients(controller=EQ_20, limits=LIMITED, prefilter={"sections": [[1, 0, 0, -1.99, 0.995]]}),
    "taps": make_coefficients(
        controller=EQ_20,
        limits=LIMITED,
        prefilter={"taps": [1.5, -0.25, -0.25] * 16, "command_taps": [0.5, 0.4, -0.3] * 17},
    ),
    "tustin": make_coefficients(controller=EQ_20 | {"method": "tustin"}, limits=LIMITED),
}
WILD = np.array([np.nan, np.inf, -np.inf, 1e308, -1e308, 9.99e8, -9.99e8, 1e-310, 60.0, -60.0, 9.99, -9.99])


@jit
def soak(law, conditions, wild, seed, ticks):
    """Run random ticks; return max |drive|, max excess over the slew in running modes and OFF, running ticks, trips."""
    np.random.seed(seed)
    coefficients, state, loop = axis_coefficients(law, 0), axis_state(law, 0), loop_state(law)
    adc, reference, feed = np.zeros(1), np.zeros(1), np.zeros(1)
    largest_v, above_slew_v, above_trip_v, running, trips = 0.0, -np.inf, -np.inf, 0, 0
    level, amplitude, hz = 0.0, 0.0, 0.0
    for k in range(ticks):
        if k % 64 == 0:  # another piece of input: a level, a sine or a square wave of any size
            level = 20.0 * np.random.randn()
            amplitude, hz = 10.0 ** np.random.uniform(-3, 6), 10.0 ** np.random.uniform(0, 3.6)
            if np.random.random() < 0.3:
                hz = 595.5
            if np.random.random() < 0.7:
                reset_trip(law)
                set_mode(law, np.random.randint(0, 4), False)
        wave = np.sin(2.0 * np.pi * hz * 1e-4 * k)
        if amplitude > 10.0:
            wave = 1.0 if wave > 0.0 else -1.0
        reference[0] = level + amplitude * wave
        adc[0], feed[0] = 2.0 * np.random.randn(), amplitude * np.random.randn()
        conditions.driver_status, conditions.heartbeat_lost = 0, 0
        conditions.sample_age_us, conditions.lateness_us, conditions.enable_v = 0.0, 0.0, 0.0
        if np.random.random() < 0.003:
            adc[0] = wild[np.random.randint(0, wild.size)]
        if np.random.random() < 0.003:
            reference[0] = wild[np.random.randint(0, wild.size)]
        if np.random.random() < 0.003:
            feed[0] = wild[np.random.randint(0, wild.size)]
        if np.random.random() < 0.001:
            conditions.driver_status = np.random.randint(-2, 2)
            conditions.heartbeat_lost = 1 if np.random.random() < 0.2 else 0
            conditions.sample_age_us = wild[np.random.randint(0, wild.size)]
            conditions.lateness_us = wild[np.random.randint(0, wild.size)]
            conditions.enable_v = wild[np.random.randint(0, wild.size)]
        if np.random.random() < 0.002:
            set_mode(law, np.random.randint(0, 4) if loop.trip == 0 else 0, False)
        last_v = state.drive_v
        evaluate(law, adc, reference, feed, conditions)
        update(law)
        drive_v = state.drive_v
        if not abs(drive_v) <= largest_v:
            largest_v = abs(drive_v)
        if loop.mode == 0:
            above_trip_v = max(above_trip_v, abs(drive_v - last_v) - coefficients.trip_slew_v_per_tick)
        else:
            running += 1
            above_slew_v = max(above_slew_v, abs(drive_v - last_v) - coefficients.slew_v_per_tick)
        trips += 1 if loop.new_trip != 0 else 0
        if not np.isfinite(drive_v):
            return np.inf, above_slew_v, above_trip_v, running, trips
    return largest_v, above_slew_v, above_trip_v, running, trips


@pytest.mark.parametrize("law", LAWS)
def test_soak(law):
    bench = LawBench(LAWS[law], Mode.CLOSED_LOOP)
    seed = sorted(LAWS).index(law)
    largest_v, above_slew_v, above_trip_v, running, trips = soak(
        bench.law.law, new_records(CONDITIONS, 1)[0], WILD, seed, TICKS_EACH
    )
    assert largest_v == 9.5
    assert above_slew_v <= 8 * np.spacing(9.5)
    assert above_trip_v <= 8 * np.spacing(9.5)
    assert running > TICKS_EACH // 10  # the loop was not tripped all the time
    assert trips > 1000
    assert bench.is_finite()
