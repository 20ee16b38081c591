"""Inputs and outputs beside the sensors and the drives, in volts, which controllers read and set by number.

An output belongs to the controller of one axis. Where that does not set it in a tick, and wherever the loop is not
closed, it is at its safe value; a value beyond its range is brought to the range's end.
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
"""What a controller is told of one axis; of several, inputs and outputs stand behind that of all."""


class ExtraOutput(NamedTuple):
    """Its name, the number of the axis whose controller sets it, and where it may be, in V."""

    name: str
    axis: int
    lowest_v: float
    highest_v: float
    safe_v: float


class Extras(NamedTuple):
    """Names of the inputs, and the outputs, in the order of their numbers."""

    inputs: tuple[str, ...] = ()
    outputs: tuple[ExtraOutput, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        """Of a record."""
        return (*(f"{name}_v" for name in self.inputs), *(f"{output.name}_v" for output in self.outputs))


@jit
def extra_inputs(record):
    """What the inputs read in this tick, (MAX_EXTRAS,)."""
    return carray(address_pointer(record.extra_inputs), MAX_EXTRAS, np.float64)


@jit
def extra_outputs(record):
    """The outputs, EXTRA_OUTPUT records (MAX_EXTRAS,)."""
    return carray(address_pointer(record.extra_outputs), MAX_EXTRAS, EXTRA_OUTPUT)


@jit
def _controller_extras(law, a, count):
    """Inputs and outputs that the controller of `count` axes from `a` on is told, (2 * MAX_EXTRAS,)."""
    place = law.controls if count == 1 else law.together
    return carray(address_pointer(place + a * CONTROL_BYTES + count * SIGNALS_BYTES), 2 * MAX_EXTRAS, np.float64)


@jit_rare
def pass_extra_inputs(record):
    """Tell every controller the inputs, and the outputs at their safe values."""
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
    """Take over the outputs that the controllers have set; all are safe where the loop is not closed.

    One that is no number is safe, and trips the next tick, as what goes wrong behind the drives does.
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
