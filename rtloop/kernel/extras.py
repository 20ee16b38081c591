"""Extra inputs and outputs, in volts, besides sensors and drives; controllers read and set them by number.

An output belongs to the controller of one axis. It has its safe value in a tick in which the controller does not set it
or the loop is not closed. A value beyond its range is limited to the range.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rtloop.foundation.native.compiled import jit, jit_rare
from rtloop.foundation.native.pointers import address_pointer, carray
from rtloop.kernel.access import CONTROL_BYTES, axis_state, coefficients_record, loop_state, unpack_law
from rtloop.kernel.layout import CONTROL_SIGNALS, EXTRA_OUTPUT, MAX_EXTRAS
from rtloop.kernel.limits import clip, is_usable
from rtloop.kernel.slots import CONTROLLER_OUTPUT, record_failure
from rtloop.signals import Flag, Mode

CLOSED_LOOP, TRIP_LAW = int(Mode.CLOSED_LOOP), int(Flag.TRIP_LAW)
SIGNALS_BYTES = len(CONTROL_SIGNALS) * 8
"""Bytes of one axis's control signals; extra inputs and outputs follow the signals of all axes of a controller."""


class ExtraOutput(NamedTuple):
    """Extra output: its name, the number of the axis whose controller sets it, its range and safe value in V."""

    name: str
    axis: int
    lowest_v: float
    highest_v: float
    safe_v: float


class Extras(NamedTuple):
    """Names of the extra inputs, and the extra outputs, in the order of their numbers."""

    inputs: tuple[str, ...] = ()
    outputs: tuple[ExtraOutput, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns of a tick's record: inputs, then outputs."""
        return (*(f"{name}_v" for name in self.inputs), *(f"{output.name}_v" for output in self.outputs))


@jit
def extra_inputs(record):
    """Return the readings of the extra inputs in this tick, a view (MAX_EXTRAS,) in V."""
    return carray(address_pointer(record.extra_inputs), MAX_EXTRAS, np.float64)


@jit
def extra_outputs(record):
    """Return the extra outputs, a view of EXTRA_OUTPUT records (MAX_EXTRAS,)."""
    return carray(address_pointer(record.extra_outputs), MAX_EXTRAS, EXTRA_OUTPUT)


@jit
def _controller_extras(law, a, count):
    """Return the extras of the controller of `count` axes from `a` on: a view (2 * MAX_EXTRAS,) in V, inputs first."""
    place = law.controls if count == 1 else law.together
    return carray(address_pointer(place + a * CONTROL_BYTES + count * SIGNALS_BYTES), 2 * MAX_EXTRAS, np.float64)


@jit_rare
def pass_extra_inputs(record):
    """Write the readings of the extra inputs, and each output's safe value, to the control records of controllers."""
    law, inputs, outputs = unpack_law(record), extra_inputs(record), extra_outputs(record)
    for a in range(law.axis_count):
        count = np.int64(coefficients_record(law, a).controller_axes)
        if count != 0:
            volts = _controller_extras(law, a, count)
            for k in range(record.extra_input_count):
                volts[k] = inputs[k]
            for k in range(record.extra_output_count):
                volts[MAX_EXTRAS + k] = outputs[k].safe_v


@jit_rare
def collect_extra_outputs(record):
    """Set the value of every extra output: in closed loop the controller's, limited to the range, else the safe value.

    A controller's value that is not a usable number is recorded as a failure of its law, leaves the output safe and
    trips the loop in the next tick.
    """
    law, outputs = unpack_law(record), extra_outputs(record)
    loop = loop_state(law)
    for k in range(record.extra_output_count):
        outputs[k].value_v = outputs[k].safe_v
    for a in range(law.axis_count):
        count = np.int64(coefficients_record(law, a).controller_axes)
        volts = _controller_extras(law, a, max(count, 1))
        for k in range(record.extra_output_count):
            if loop.mode == CLOSED_LOOP and a <= outputs[k].axis < a + count:
                value_v = volts[MAX_EXTRAS + k]
                if is_usable(value_v):
                    outputs[k].value_v = clip(value_v, outputs[k].lowest_v, outputs[k].highest_v)
                else:
                    record_failure(axis_state(law, a), CONTROLLER_OUTPUT, value_v)
                    loop.pending |= TRIP_LAW
