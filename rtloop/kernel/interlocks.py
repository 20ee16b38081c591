"""Interlocks: each trip condition is one line of `axis_trip` or `loop_causes`, for the bit, unit and message in `Flag`.

An interlock is a pure function of recorded inputs and of the law's state, so a replay trips at the same tick for the
same cause. The counters of conditions that take several ticks are in the axis's state.
"""

from __future__ import annotations

import numpy as np

from rtloop.foundation.native.compiled import jit
from rtloop.signals import TRIP_MASK, Flag, Mode

CLOSED_LOOP = int(Mode.CLOSED_LOOP)
NON_FINITE, SENSOR_RANGE, POSITION, DRIVER, HEARTBEAT, STALE, FROZEN, TRACKING, OSCILLATION, LATE, ENABLE, LAW = (
    int(flag) for flag in Flag if flag & TRIP_MASK
)
EVALUATED = ~LAW
"""Causes that `axis_trip` evaluates in every tick; the failure of a law is reported where the law is called."""
NO_AXIS = -1
TRIP = np.dtype(
    [*((name, np.int64) for name in ("axis", "cause", "law")), ("value", np.float64), ("limit", np.float64)]
)
"""First cause of the newest trip: number of the axis (NO_AXIS for none), Flag bit, number of the law, its value
and limit."""

INTERLOCK_FIELDS = [
    ("sensor_min_v", np.float64),
    ("sensor_max_v", np.float64),
    ("position_limit_um", np.float64),
    ("sample_age_limit_us", np.float64),
    ("enable_min_v", np.float64),
    ("frozen_drive_v", np.float64),
    ("frozen_ticks", np.int64),
    ("tracking_error_um", np.float64),
    ("tracking_ticks", np.int64),
    ("oscillation_um", np.float64),
    ("oscillation_swings", np.int64),
    ("swing_ticks", np.int64),
    ("late_us", np.float64),
    ("late_ticks", np.int64),
]
"""Limits of the interlocks; those whose names are configuration keys are copied from the configuration."""
INTERLOCK_STATE = [
    ("frozen_adc_v", np.float64),
    ("frozen_from_v", np.float64),
    ("frozen_count", np.int64),
    ("tracking_count", np.int64),
    ("swing_extreme_um", np.float64),
    ("swing_direction", np.int64),
    ("swing_age", np.int64),
    ("swing_count", np.int64),
    ("late_count", np.int64),
]
"""Counters and memory of the interlocks, a part of each axis's state."""


@jit
def axis_trip(coefficients, state, adc_v, conditions, among):
    """Evaluate the trip conditions of one axis whose Flag bits are in `among`; call `count_ticks` first in each tick.

    Returns the causes as Flag bits, then the first cause with its value and limit; zeros without a cause. For a failed
    law, the value is the number that it returned, and the limit is the `Failure` code.
    """
    c, s = coefficients, state
    age_us, limit_um = conditions.sample_age_us, c.position_limit_um
    is_frozen = s.frozen_count >= c.frozen_ticks > 0 and abs(s.drive_v - s.frozen_from_v) > c.frozen_drive_v
    trip = 0, 0, 0.0, 0.0
    trip = _check(trip, among, LAW, s.failed != 0, s.failed_value, s.failed)
    trip = _check(trip, among, NON_FINITE, s.usable == 0, adc_v, 0.0)
    trip = _check(trip, among, SENSOR_RANGE, adc_v < c.sensor_min_v, adc_v, c.sensor_min_v)
    trip = _check(trip, among, SENSOR_RANGE, adc_v > c.sensor_max_v, adc_v, c.sensor_max_v)
    trip = _check(trip, among, POSITION, s.position_um > limit_um, s.position_um, limit_um)
    trip = _check(trip, among, POSITION, s.position_um < -limit_um, s.position_um, -limit_um)
    trip = _check(trip, among, STALE, not age_us <= c.sample_age_limit_us, age_us, c.sample_age_limit_us)
    trip = _check(trip, among, ENABLE, not conditions.enable_v >= c.enable_min_v, conditions.enable_v, c.enable_min_v)
    trip = _check(trip, among, FROZEN, is_frozen, s.frozen_count, c.frozen_ticks)
    trip = _check(trip, among, LATE, s.late_count >= c.late_ticks > 0, conditions.lateness_us, c.late_us)
    trip = _check(trip, among, TRACKING, s.tracking_count >= c.tracking_ticks > 0, s.error_um, c.tracking_error_um)
    return _check(
        trip, among, OSCILLATION, s.swing_count >= c.oscillation_swings > 0, s.swing_count, c.oscillation_swings
    )


@jit
def _check(trip, among, flag, is_tripped, value, limit):
    """Return `trip`, a tuple as `axis_trip` returns, with the cause `flag` added if `is_tripped` and `among` has it.

    The first cause added sets the value and the limit.
    """
    causes, first, first_value, first_limit = trip
    if not is_tripped or among & flag == 0:
        return trip
    if causes == 0:
        first, first_value, first_limit = flag, float(value), float(limit)
    return causes | flag, first, first_value, first_limit


@jit
def loop_causes(conditions):
    """Return the trip causes of the whole loop as Flag bits: a failed driver (status below 0), a lost heartbeat."""
    return (DRIVER if conditions.driver_status < 0 else 0) | (HEARTBEAT if conditions.heartbeat_lost != 0 else 0)


@jit
def count_ticks(coefficients, state, mode, adc_v, lateness_us):
    """Advance the counters of one axis by a tick: equal readings, late ticks, ticks of a large error, swings.

    A condition with the limit 0 is not counted. Outside closed loop, errors and swings start again from 0.
    """
    if coefficients.frozen_ticks > 0:
        if adc_v != state.frozen_adc_v:
            state.frozen_adc_v, state.frozen_from_v, state.frozen_count = adc_v, state.drive_v, 0
        else:
            state.frozen_count += 1
    if coefficients.late_ticks > 0:
        state.late_count = state.late_count + 1 if lateness_us > coefficients.late_us else 0
    if mode != CLOSED_LOOP:
        state.tracking_count = state.swing_count = state.swing_age = 0
        state.swing_extreme_um = state.position_um
        return
    if coefficients.tracking_ticks > 0:
        is_large = abs(state.error_um) > coefficients.tracking_error_um
        state.tracking_count = state.tracking_count + 1 if is_large else 0
    if coefficients.oscillation_swings > 0:
        _count_swings(coefficients, state)


@jit
def _count_swings(coefficients, state):
    """Add 1 to `state.swing_count` where the position has turned back by more than `oscillation_um` since its extreme.

    More than `swing_ticks` without such a reversal set the count to 0. Called once per tick.
    """
    position_um, extreme_um = state.position_um, state.swing_extreme_um
    state.swing_age += 1
    if state.swing_age > coefficients.swing_ticks:
        state.swing_count = 0
    sign = 1 if state.swing_direction >= 0 else -1
    if sign * position_um > sign * extreme_um:
        state.swing_extreme_um = position_um
    elif sign * position_um < sign * extreme_um - coefficients.oscillation_um:
        state.swing_direction = -sign
        state.swing_extreme_um = position_um
        state.swing_count += 1
        state.swing_age = 0
