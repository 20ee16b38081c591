"""Limits and interlocks: what the drive may be, and when the loop must give up.

An interlock is a pure function of recorded inputs, so a replay trips at the same tick for the same cause.
"""

from __future__ import annotations

from rtloop.foundation.native.compiled import jit
from rtloop.signals import Flag

USABLE_MAGNITUDE = 1e9
"""Inputs and references beyond this, infinite or NaN are not numbers to compute with."""

NON_FINITE = int(Flag.TRIP_NON_FINITE)
SENSOR_RANGE = int(Flag.TRIP_SENSOR_RANGE)
POSITION = int(Flag.TRIP_POSITION)
DRIVER = int(Flag.TRIP_DRIVER)
HEARTBEAT = int(Flag.TRIP_HEARTBEAT)
STALE = int(Flag.TRIP_STALE)
ENABLE = int(Flag.TRIP_ENABLE)


@jit
def is_usable(value):
    """True for a finite number of sane magnitude."""
    return -USABLE_MAGNITUDE < value < USABLE_MAGNITUDE


@jit
def clip(value, low, high):
    """`value` within low … high."""
    return low if value < low else (high if value > high else value)


@jit
def step_toward(value, target, step):
    """`value` moved toward `target` by at most `step`."""
    return clip(target, value - step, value + step)


@jit
def axis_causes(coefficients, state, adc_v, conditions):
    """Flag bits of what is wrong on one axis; `state.usable` and `state.position_um` are set before."""
    causes = 0
    if state.usable == 0:
        causes |= NON_FINITE
    if adc_v < coefficients.sensor_min_v or adc_v > coefficients.sensor_max_v:
        causes |= SENSOR_RANGE
    if state.position_um < -coefficients.position_limit_um or state.position_um > coefficients.position_limit_um:
        causes |= POSITION
    if not conditions.sample_age_us <= coefficients.sample_age_limit_us:
        causes |= STALE
    if not conditions.enable_v >= coefficients.enable_min_v:
        causes |= ENABLE
    return causes


@jit
def loop_causes(conditions):
    """Flag bits of what is wrong for all axes at once."""
    causes = 0
    if conditions.driver_status < 0:
        causes |= DRIVER
    if conditions.heartbeat_lost != 0:
        causes |= HEARTBEAT
    return causes
