"""A fault of the rig from a time on: a reading that stands still or is lost, or an actuator without voltage.

The actuator and its motion go on as they are; interlocks have to find the fault from the readings.
"""

from __future__ import annotations

from rtloop.foundation.native.compiled import jit

KINDS = ("none", "sensor_stuck", "sensor_lost", "drive_lost")
"""Kinds of faults; their places are the values of `fault_kind`."""
SENSOR_STUCK, SENSOR_LOST, DRIVE_LOST = (KINDS.index(kind) for kind in KINDS[1:])

COEFFICIENTS = [("fault_kind", "i8")]
STATE = [("fault_wait", "i8"), ("fault_reading_v", "f8")]


@jit
def change_reading(coefficients, state, reading_v):
    """Return the reading [V] that the controller gets in place of `reading_v`.

    Until the fault begins, it is `reading_v`. Then it is the last reading before the fault if the sensor is stuck, 0 V
    if the sensor is lost, and still `reading_v` for a lost drive or no fault. Each call before the fault stores
    `reading_v` in `state`; `change_drive` counts the time.
    """
    if state.fault_wait > 0:
        state.fault_reading_v = reading_v
        return reading_v
    if coefficients.fault_kind == SENSOR_STUCK:
        return state.fault_reading_v
    if coefficients.fault_kind == SENSOR_LOST:
        return 0.0
    return reading_v


@jit
def change_drive(coefficients, state, drive_v):
    """Return the voltage [V] at the actuator in the period that begins: `drive_v`, 0 V once the drive is lost.

    Each call counts `fault_wait`, the periods until the fault begins, down by one.
    """
    if state.fault_wait > 0:
        state.fault_wait -= 1
        return drive_v
    if coefficients.fault_kind == DRIVE_LOST:
        return 0.0
    return drive_v
