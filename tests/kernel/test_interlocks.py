"""Interlocks with memory: each trips for its cause, exactly at the tick of its definition."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.signals import Flag, Mode
from tests.kernel.harness import EQ_20, KEEP, LawBench, coefficients_of

NEVER = -1


def first_trip(bench: LawBench, flag: Flag, *inputs, **more) -> int:
    """Tick of the first trip for `flag`; no other cause may come with it."""
    flags = bench.run(*inputs, **more).flags.astype(int)
    trips = np.flatnonzero(flags & int(flag))
    if trips.size == 0:
        assert not np.any(flags >> 8)
        return NEVER
    first = int(trips[0])
    assert not np.any(flags[:first] >> 8)
    assert flags[first] >> 8 == int(flag) >> 8
    return first


def bench_of(mode: Mode = Mode.RAW, **interlocks) -> LawBench:
    return LawBench(coefficients_of(controller=EQ_20, interlocks=interlocks), mode)


def test_frozen_needs_a_reading_that_stands_and_a_drive_that_moves():
    ticks = np.arange(400)
    drive_v, noise = ticks * 0.01, np.where(ticks < 100, ticks * 1e-3, 0.099)
    # the reading stands from tick 99 on, when the last drive was 0.98 V; in tick 150 the last drive is 1.49 V
    assert first_trip(bench_of(frozen_ticks=20), Flag.TRIP_FROZEN, drive_v, noise) == 150
    assert first_trip(bench_of(frozen_ticks=150), Flag.TRIP_FROZEN, drive_v, noise) == 249
    assert first_trip(bench_of(frozen_ticks=20), Flag.TRIP_FROZEN, np.full(400, 0.4), noise) == NEVER
    assert first_trip(bench_of(), Flag.TRIP_FROZEN, drive_v, noise) == NEVER


def test_an_error_that_lasts():
    error = np.zeros(400)
    error[100:149], error[200:250] = 7.0, -7.0  # 49 ticks, then 50
    limits = {"tracking_error_um": 6.0, "tracking_ticks": 50}
    # an error is judged in the tick after it was made
    assert first_trip(bench_of(Mode.CLOSED_LOOP, **limits), Flag.TRIP_TRACKING, error, 0.0) == 250
    assert first_trip(bench_of(Mode.FEEDFORWARD, **limits), Flag.TRIP_TRACKING, error, 0.0) == NEVER


def test_an_error_of_one_tick_may_be_one_too_many():
    error = np.zeros(40)
    error[20] = 7.0
    limits = {"tracking_error_um": 6.0, "tracking_ticks": 1}
    assert first_trip(bench_of(Mode.CLOSED_LOOP, **limits), Flag.TRIP_TRACKING, error, 0.0) == 21


def test_an_error_that_lasts_is_counted_anew_after_mode_off():
    """Thirty ticks of an error, OFF, thirty more: neither lasted for fifty."""
    modes = np.full(200, KEEP)
    modes[[130, 135]] = Mode.OFF, Mode.CLOSED_LOOP
    error = np.zeros(200)
    error[100:165] = 7.0
    bench = bench_of(Mode.CLOSED_LOOP, tracking_error_um=6.0, tracking_ticks=50)
    assert first_trip(bench, Flag.TRIP_TRACKING, error, modes=modes) == NEVER
    bench = bench_of(Mode.CLOSED_LOOP, tracking_error_um=6.0, tracking_ticks=50)
    assert first_trip(bench, Flag.TRIP_TRACKING, error) == 150


@pytest.mark.parametrize(
    ("hz", "amplitude_um", "trips"), [(600.0, 3.0, True), (600.0, 1.9, False), (50.0, 20.0, False)]
)
def test_swings_that_do_not_end(hz, amplitude_um, trips):
    position_um = amplitude_um * np.sin(2 * np.pi * hz * np.arange(2000) * 1e-4)
    bench = bench_of(Mode.CLOSED_LOOP, oscillation_um=4.0, oscillation_swings=8)
    tick = first_trip(bench, Flag.TRIP_OSCILLATION, 0.0 * position_um, position_um / 10)
    assert (tick != NEVER) == trips
    if trips:  # eight half periods of 8.33 ticks each, the first one from rest
        assert 58 <= tick <= 76


def test_swings_are_counted_anew_after_a_pause():
    """Three swings, a pause, and four swings of twenty ticks each: the fourth after the pause trips."""
    bench = bench_of(Mode.CLOSED_LOOP, oscillation_um=4.0, oscillation_swings=4)
    pause = int(bench.coefficients["swing_ticks"][0]) + 1
    levels_um = [3.0, -3.0, 3.0, *[-3.0] * (pause // 20 + 1), 3.0, -3.0, 3.0, -3.0, 3.0]
    position_um = np.repeat(levels_um, 20)
    fourth = 20 * (len(levels_um) - 2)
    assert first_trip(bench, Flag.TRIP_OSCILLATION, 0.0 * position_um, position_um / 10) == fourth


def test_a_step_is_no_oscillation():
    ringing = 20 * (1 - np.exp(-np.arange(1000) / 12) * np.cos(np.arange(1000) / 4))
    bench = bench_of(Mode.CLOSED_LOOP, oscillation_um=4.0, oscillation_swings=8)
    assert first_trip(bench, Flag.TRIP_OSCILLATION, np.full(1000, 20.0), ringing / 10) == NEVER


def test_late_ticks_in_a_row():
    late_us = np.zeros(300)
    late_us[50:59], late_us[100:110] = 600.0, 600.0  # nine, then ten
    bench = bench_of(late_us=500.0, late_ticks=10)
    assert first_trip(bench, Flag.TRIP_LATE, np.zeros(300), late_us=late_us) == 109
    late_us[:] = np.nan  # virtual time
    assert first_trip(bench_of(late_us=500.0, late_ticks=10), Flag.TRIP_LATE, np.zeros(300), late_us=late_us) == NEVER


@pytest.mark.parametrize("opened", [0.0, np.nan])
def test_the_enable_input(opened):
    coefficients = coefficients_of()
    coefficients["enable_min_v"] = 2.5
    enable_v = np.full(200, 5.0)
    enable_v[77:] = opened
    assert first_trip(LawBench(coefficients, Mode.RAW), Flag.TRIP_ENABLE, np.zeros(200), enable_v=enable_v) == 77
