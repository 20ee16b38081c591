"""The event of a trip: which axis, by which value beyond which limit. Not judged here: the law has, a tick is told of.

The conditions are those of `rtloop.kernel.safety` and `rtloop.kernel.watch`, on the same inputs and the same state.
"""

from __future__ import annotations

from rtloop.engine.commands import publish_event
from rtloop.engine.context import float_array, law_record, tick_conditions
from rtloop.engine.messages import ALL_AXES, Kind, Origin
from rtloop.foundation.native.compiled import jit_rare
from rtloop.kernel.access import axis_state, coefficients_record
from rtloop.signals import Failure, Flag

TRIPPED, LOOP = int(Kind.TRIPPED), int(Origin.LOOP)
FEEDFORWARD_FAILURES = float(Failure.FEEDFORWARD_OUTPUT)
NON_FINITE, SENSOR_RANGE, POSITION, STALE, ENABLE, FROZEN, LATE, TRACKING, OSCILLATION, LAW = (
    int(flag)
    for flag in (
        *(Flag.TRIP_NON_FINITE, Flag.TRIP_SENSOR_RANGE, Flag.TRIP_POSITION, Flag.TRIP_STALE, Flag.TRIP_ENABLE),
        *(Flag.TRIP_FROZEN, Flag.TRIP_LATE, Flag.TRIP_TRACKING, Flag.TRIP_OSCILLATION, Flag.TRIP_LAW),
    )
)


@jit_rare
def publish_trip(loop, causes):
    """One event of all new `causes`, with the first axis and cause that explains it, the value and its limit."""
    law = law_record(loop)
    adc_v = float_array(loop.adc_v, loop.axis_count)
    for a in range(loop.axis_count):
        coefficients, state = coefficients_record(law, a), axis_state(law, a)
        cause, value, limit = _first_cause(coefficients, state, adc_v[a], tick_conditions(loop), causes)
        if cause != 0:
            number = coefficients.feedforward_law if limit >= FEEDFORWARD_FAILURES else coefficients.controller_law
            publish_event(loop, TRIPPED, a, LOOP, 0, (float(causes), value, limit, float(cause), float(number)))
            return
    publish_event(loop, TRIPPED, ALL_AXES, LOOP, 0, (float(causes), 0.0, 0.0, 0.0))


@jit_rare
def _first_cause(coefficients, state, adc_v, conditions, causes):
    """Flag bit, value and limit of what is wrong on one axis; 0 where nothing among `causes` is."""
    if causes & LAW != 0 and state.failed != 0:
        return LAW, state.failed_value, float(state.failed)
    if causes & NON_FINITE != 0 and state.usable == 0:
        return NON_FINITE, adc_v, 0.0
    if causes & SENSOR_RANGE != 0 and adc_v < coefficients.sensor_min_v:
        return SENSOR_RANGE, adc_v, coefficients.sensor_min_v
    if causes & SENSOR_RANGE != 0 and adc_v > coefficients.sensor_max_v:
        return SENSOR_RANGE, adc_v, coefficients.sensor_max_v
    if causes & POSITION != 0 and state.position_um > coefficients.position_limit_um:
        return POSITION, state.position_um, coefficients.position_limit_um
    if causes & POSITION != 0 and state.position_um < -coefficients.position_limit_um:
        return POSITION, state.position_um, -coefficients.position_limit_um
    if causes & STALE != 0 and not conditions.sample_age_us <= coefficients.sample_age_limit_us:
        return STALE, conditions.sample_age_us, coefficients.sample_age_limit_us
    if causes & ENABLE != 0 and not conditions.enable_v >= coefficients.enable_min_v:
        return ENABLE, conditions.enable_v, coefficients.enable_min_v
    if causes & FROZEN != 0 and state.frozen_count >= coefficients.frozen_ticks > 0:
        return FROZEN, float(state.frozen_count), float(coefficients.frozen_ticks)
    if causes & LATE != 0 and state.late_count >= coefficients.late_ticks > 0:
        return LATE, conditions.lateness_us, coefficients.late_us
    if causes & TRACKING != 0 and state.tracking_count >= coefficients.tracking_ticks > 0:
        return TRACKING, state.error_um, coefficients.tracking_error_um
    if causes & OSCILLATION != 0 and state.swing_count >= coefficients.oscillation_swings > 0:
        return OSCILLATION, float(state.swing_count), float(coefficients.oscillation_swings)
    return 0, 0.0, 0.0
