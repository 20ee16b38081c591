"""Soundness of readings while all outputs are safe: the same limits as those of the interlocks, without their patience.

An interlock tolerates a late tick or an old sample for a while; a confirmation tolerates none.
"""

from __future__ import annotations

import numpy as np

from rtloop import signals
from rtloop.configuration.axis import InterlockOptions
from rtloop.configuration.prepare import Prepared
from rtloop.drivers.base import Channel, channel_index
from rtloop.foundation.arrays import Real
from rtloop.recording.file.topics.recovery_steps import StepReason
from rtloop.signals import Flag, Mode

RAIL_SHARE = 1e-3
"""Share of a channel's range at either end in which a reading counts as stuck at the rail: two codes of 11 bits."""


def unsound_reason(rows: Real, prepared: Prepared) -> StepReason | None:
    """Return why the records `rows` (n, columns), n > 0, are not sound; None if every tick is sound.

    In this order: ticks missing, a fault of the driver, outputs that are not safe, then for each axis the age of the
    sample, reading, position and lateness, and the enable input if there is one.
    """
    flags = rows[:, signals.FLAGS].astype(np.int64)
    if np.any(np.diff(rows[:, signals.TICK]) != 1):
        return StepReason.NO_TICKS
    if np.any(rows[:, signals.DRIVER_STATUS] != 0):
        return StepReason.DRIVER
    is_moving = np.any(rows[:, signals.MODE] != Mode.OFF) or np.any(flags & (Flag.RAMPING | Flag.WRITE_FAILED))
    if is_moving or _drives_beside_safe(rows, prepared):
        return StepReason.OUTPUTS
    configuration = prepared.configuration
    for number, axis in enumerate(configuration.axes):
        channel = prepared.facts.inputs[channel_index(prepared.facts.inputs, configuration.channels[axis.name].input)]
        reason = _axis_reason(rows, number, axis.interlocks, channel)
        if reason is None and configuration.loop.enable_input is not None:
            is_enabled = np.all(rows[:, signals.ENABLE] >= axis.interlocks.enable_min_v)
            reason = None if is_enabled else StepReason.ENABLE
        if reason is not None:
            return reason
    return None


def _drives_beside_safe(rows: Real, prepared: Prepared) -> bool:
    """Return whether some axis has another drive than its safe value in some record of `rows` (ticks, columns)."""
    safe_v = np.asarray(prepared.plan.coefficients)["safe_v"]
    columns = [signals.axis_column(number, signals.DRIVE) for number in range(len(safe_v))]
    return bool(np.any(rows[:, columns] != safe_v))


def _axis_reason(rows: Real, number: int, limits: InterlockOptions, channel: Channel) -> StepReason | None:
    """Return why the readings of axis `number` are not sound: age, reading, position or, with `late_ticks`, lateness.
    None if all are within their limits; NaN is not.
    """
    adc_v = rows[:, signals.axis_column(number, signals.ADC)]
    position_um = rows[:, signals.axis_column(number, signals.POSITION)]
    margin_v = RAIL_SHARE * (channel.maximum_v - channel.minimum_v)
    lowest_v = max(limits.sensor_min_v, channel.minimum_v + margin_v)
    highest_v = min(limits.sensor_max_v, channel.maximum_v - margin_v)
    if not np.all(rows[:, signals.SAMPLE_AGE] <= limits.sample_age_us):
        return StepReason.AGE
    if not np.all((adc_v > lowest_v) & (adc_v < highest_v)):
        return StepReason.SENSOR
    if not np.all(np.abs(position_um) <= limits.position_um):
        return StepReason.POSITION
    if limits.late_ticks and not np.all(rows[:, signals.LATENESS] <= limits.late_us):
        return StepReason.LATENESS
    return None
