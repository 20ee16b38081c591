"""ADC and DAC: n bits from `min_v` to `range_v`, and the whole periods that a written value takes to arrive.

    V = LSB · rint(V / LSB), half to even, min <= V <= range − LSB,      LSB = (range − min) / 2^n

The highest value is one LSB below the range, as in a two's complement converter. 0 bits is an ideal converter: no
steps, but clipped to the range all the same.
"""

from __future__ import annotations

import math

import numpy as np

from rtloop.foundation.native.compiled import jit

MAX_LATENCY = 16

COEFFICIENTS = [
    ("adc_lsb_v", "f8"),
    ("adc_lowest_v", "f8"),
    ("adc_highest_v", "f8"),
    ("dac_lsb_v", "f8"),
    ("dac_lowest_v", "f8"),
    ("dac_highest_v", "f8"),
    ("latency_ticks", "i8"),
]
STATE = [("dac_v", "f8"), ("queue_v", "f8", (MAX_LATENCY,)), ("queue_head", "i8")]


def lsb_and_range(min_v: float, range_v: float, bits: int) -> tuple[float, float, float]:
    """Return the LSB (0 for an ideal converter, `bits` 0), the lowest and the highest value [V] of a converter."""
    if bits == 0:
        return 0.0, min_v, range_v
    lsb_v = (range_v - min_v) / 2**bits
    return lsb_v, min_v, range_v - lsb_v


@jit
def quantise(lsb_v, lowest_v, highest_v, value_v):
    """Return the converter's voltage, a multiple of `lsb_v`, nearest to `value_v` [V], within its range. NaN stays NaN.

    An ideal converter, with `lsb_v` 0, only clips the value to its range.
    """
    if lsb_v > 0.0:
        value_v = np.rint(value_v / lsb_v) * lsb_v
    if value_v < lowest_v:
        return lowest_v
    if value_v > highest_v:
        return highest_v
    return value_v


@jit
def digitise(coefficients, value_v):
    """Return the ADC's reading [V] of `value_v`: the nearest code's voltage, within the range."""
    return quantise(coefficients.adc_lsb_v, coefficients.adc_lowest_v, coefficients.adc_highest_v, value_v)


@jit
def write_dac(coefficients, state, value_v):
    """Write `value_v` to the DAC and return the voltage at the actuator for the period that begins [V].

    NaN holds the last written value. With a latency of n, the actuator gets the value written n periods ago, and 0 V
    before the first.
    """
    if not math.isnan(value_v):
        state.dac_v = quantise(coefficients.dac_lsb_v, coefficients.dac_lowest_v, coefficients.dac_highest_v, value_v)
    latency = coefficients.latency_ticks
    if latency == 0:
        return state.dac_v
    head = state.queue_head
    delayed_v = state.queue_v[head]
    state.queue_v[head] = state.dac_v
    state.queue_head = head + 1 if head + 1 < latency else 0
    return delayed_v
