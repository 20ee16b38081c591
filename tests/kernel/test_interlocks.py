"""Interlocks with memory: each trips for its cause, exactly in the tick that its definition gives."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.signals import Flag, Mode
from tests.kernel.harness import EQ_20, KEEP, LawBench, make_coefficients

NEVER = -1


def first_trip(bench: LawBench, flag: Flag, *inputs, **options) -> int:
    """Return the tick of the first trip for `flag`, or NEVER; an earlier or other cause of a trip fails the test."""
    flags = bench.run(*inputs, **options).flags.astype(int)
    trips = np.flatnonzero(flags & int(flag))
    if trips.size == 0:
        assert not np.any(flags >> 8)
        return NEVER
    first = int(trips[0])
    assert not np.any(flags[:first] >> 8)
    assert flags[first] >> 8 == int(flag) >> 8
    return first


def make_bench(mode: Mode = Mode.RAW, **interlocks) -> LawBench:
    """Return a bench of the law of eq (20) with these interlocks."""
    return LawBench(make_coefficients(controller=EQ_20, interlocks=interlocks), mode)


def test_frozen_needs_a_reading_that_stands_and_a_drive_that_moves():
    ticks = np.arange(400)
    drive_v, reading_v = ticks * 0.01, np.where(ticks < 100, ticks * 1e-3, 0.099)
    # The reading is constant from tick 99 on, when the last drive was 0.98 V; in tick 150 the last drive is 1.49 V.
    assert first_trip(make_bench(frozen_ticks=20), Flag.TRIP_FROZEN, drive_v, reading_v) == 150
    assert first_trip(make_bench(frozen_ticks=150), Flag.TRIP_FROZEN, drive_v, reading_v) == 249
    assert first_trip(make_bench(frozen_ticks=20), Flag.TRIP_FROZEN, np.full(400, 0.4), reading_v) == NEVER
    assert first_trip(make_bench(), Flag.TRIP_FROZEN, drive_v, reading_v) == NEVER


def test_an_error_that_lasts():
    error = np.zeros(400)
    error[100:149], error[200:250] = 7.0, -7.0  # 49 ticks, then 50
    limits = {"tracking_error_um": 6.0, "tracking_ticks": 50}
    # The interlock evaluates an error in the tick after it occurs.
    assert first_trip(make_bench(Mode.CLOSED_LOOP, **limits), Flag.TRIP_TRACKING, error, 0.0) == 250
    assert first_trip(make_bench(Mode.FEEDFORWARD, **limits), Flag.TRIP_TRACKING, error, 0.0) == NEVER


def test_an_error_of_one_tick_may_be_one_too_many():
    error = np.zeros(40)
    error[20] = 7.0
    limits = {"tracking_error_um": 6.0, "tracking_ticks": 1}
    assert first_trip(make_bench(Mode.CLOSED_LOOP, **limits), Flag.TRIP_TRACKING, error, 0.0) == 21


def test_an_error_that_lasts_is_counted_anew_after_mode_off():
    """The error lasts 30 ticks before OFF and 30 ticks after it, neither time for the limit of 50."""
    modes = np.full(200, KEEP)
    modes[[130, 135]] = Mode.OFF, Mode.CLOSED_LOOP
    error = np.zeros(200)
    error[100:165] = 7.0
    bench = make_bench(Mode.CLOSED_LOOP, tracking_error_um=6.0, tracking_ticks=50)
    assert first_trip(bench, Flag.TRIP_TRACKING, error, modes=modes) == NEVER
    bench = make_bench(Mode.CLOSED_LOOP, tracking_error_um=6.0, tracking_ticks=50)
    assert first_trip(bench, Flag.TRIP_TRACKING, error) == 150


@pytest.mark.parametrize(
    ("hz", "amplitude_um", "trips"), [(600.0, 3.0, True), (600.0, 1.9, False), (50.0, 20.0, False)]
)
def test_swings_that_do_not_end(hz, amplitude_um, trips):
    position_um = amplitude_um * np.sin(2 * np.pi * hz * np.arange(2000) * 1e-4)
    bench = make_bench(Mode.CLOSED_LOOP, oscillation_um=4.0, oscillation_swings=8)
    tick = first_trip(bench, Flag.TRIP_OSCILLATION, 0.0 * position_um, position_um / 10)
    assert (tick != NEVER) == trips
    if trips:  # eight half periods of 8.33 ticks each, the first one from rest
        assert 58 <= tick <= 76


def test_swings_are_counted_anew_after_a_pause():
    """Three swings, a pause, and four swings of twenty ticks each: the fourth after the pause trips."""
    bench = make_bench(Mode.CLOSED_LOOP, oscillation_um=4.0, oscillation_swings=4)
    pause_ticks = int(bench.coefficients["swing_ticks"][0]) + 1
    levels_um = [3.0, -3.0, 3.0, *[-3.0] * (pause_ticks // 20 + 1), 3.0, -3.0, 3.0, -3.0, 3.0]
    position_um = np.repeat(levels_um, 20)
    fourth_tick = 20 * (len(levels_um) - 2)
    assert first_trip(bench, Flag.TRIP_OSCILLATION, 0.0 * position_um, position_um / 10) == fourth_tick


def test_a_step_is_no_oscillation():
    ringing = 20 * (1 - np.exp(-np.arange(1000) / 12) * np.cos(np.arange(1000) / 4))
    bench = make_bench(Mode.CLOSED_LOOP, oscillation_um=4.0, oscillation_swings=8)
    assert first_trip(bench, Flag.TRIP_OSCILLATION, np.full(1000, 20.0), ringing / 10) == NEVER


def test_late_ticks_in_a_row():
    late_us = np.zeros(300)
    late_us[50:59], late_us[100:110] = 600.0, 600.0  # nine, then ten
    bench = make_bench(late_us=500.0, late_ticks=10)
    assert first_trip(bench, Flag.TRIP_LATE, np.zeros(300), late_us=late_us) == 109
    late_us[:] = np.nan  # virtual time
    assert first_trip(make_bench(late_us=500.0, late_ticks=10), Flag.TRIP_LATE, np.zeros(300), late_us=late_us) == NEVER


@pytest.mark.parametrize("open_v", [0.0, np.nan])
def test_the_enable_input(open_v):
    coefficients = make_coefficients()
    coefficients["enable_min_v"] = 2.5
    enable_v = np.full(200, 5.0)
    enable_v[77:] = open_v
    assert first_trip(LawBench(coefficients, Mode.RAW), Flag.TRIP_ENABLE, np.zeros(200), enable_v=enable_v) == 77
