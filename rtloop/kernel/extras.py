"""Extra inputs and outputs, in volts, besides sensors and drives; controllers read and set them by number.

An output belongs to the controller of one axis, or it is a mark, which the reference or the position of its axis sets.
It has its safe value in a tick in which nothing sets it, or in which the loop is not closed; a mark follows the
reference in mode feedforward too. A value beyond its range is limited to the range.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from rtloop.foundation.native.compiled import jit, jit_rare
from rtloop.foundation.native.pointers import address_pointer, carray
from rtloop.kernel.access import CONTROL_BYTES, axis_state, coefficients_record, loop_state, unpack_law
from rtloop.kernel.layout import CONTROL_SIGNALS, EXTRA_OUTPUT, MAX_EXTRAS
from rtloop.kernel.limits import clip, is_usable
from rtloop.kernel.slots import CONTROLLER_OUTPUT, record_failure
from rtloop.signals import Flag, Mode

CLOSED_LOOP, FEEDFORWARD, TRIP_LAW = int(Mode.CLOSED_LOOP), int(Mode.FEEDFORWARD), int(Flag.TRIP_LAW)
SIGNALS_BYTES = len(CONTROL_SIGNALS) * 8
"""Bytes of one axis's control signals; extra inputs and outputs follow the signals of all axes of a controller."""


class Mark(IntEnum):
    """Kinds of marks by the condition under which the output is high; NONE is an output that a controller sets."""

    NONE = 0
    RISING = 1
    """the reference, after its pre-filter, rises"""
    MOVING = 2
    """the reference, after its pre-filter, changes"""
    POSITION = 3
    """the measured position is at the level or above it"""


RISING, MOVING, POSITION = int(Mark.RISING), int(Mark.MOVING), int(Mark.POSITION)
SMALLEST_STEP_UM = 1e-6
"""Changes of the reference in one tick up to this size count as none."""


class ExtraOutput(NamedTuple):
    """Extra output: its name, the number of its axis, its range and safe value in V; `level_um` of Mark.POSITION.

    The axis's controller sets it, or its mark.
    """

    name: str
    axis: int
    lowest_v: float
    highest_v: float
    safe_v: float
    mark: int = 0
    level_um: float = 0.0


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
def set_marks(record, a, step_um, position_um):
    """Set `is_high` of the marks of axis `a`, 1 or 0, from the reference's change since the last tick and the position.

    `step_um` is this change, with its sign; outputs of axis `a` that are no marks get 0.
    """
    outputs = extra_outputs(record)
    for k in range(record.extra_output_count):
        if outputs[k].axis == a:
            is_high = outputs[k].mark == RISING and step_um > SMALLEST_STEP_UM
            is_high = is_high or (outputs[k].mark == MOVING and abs(step_um) > SMALLEST_STEP_UM)
            is_high = is_high or (outputs[k].mark == POSITION and position_um >= outputs[k].level_um)
            outputs[k].is_high = 1 if is_high else 0


@jit_rare
def collect_extra_outputs(record):
    """Set the value of every extra output: in closed loop the controller's, limited to the range, else the safe value.

    A mark that is high has the upper end of its range in closed loop and feedforward.

    A controller's value that is not a usable number is recorded as a failure of its law, leaves the output safe and
    trips the loop in the next tick.
    """
    law, outputs = unpack_law(record), extra_outputs(record)
    loop = loop_state(law)
    for k in range(record.extra_output_count):
        is_high = outputs[k].is_high != 0 and (loop.mode == CLOSED_LOOP or loop.mode == FEEDFORWARD)
        outputs[k].value_v = outputs[k].highest_v if is_high else outputs[k].safe_v
    for a in range(law.axis_count):
        count = np.int64(coefficients_record(law, a).controller_axes)
        volts = _controller_extras(law, a, max(count, 1))
        for k in range(record.extra_output_count):
            if loop.mode == CLOSED_LOOP and outputs[k].mark == 0 and a <= outputs[k].axis < a + count:
                value_v = volts[MAX_EXTRAS + k]
                if is_usable(value_v):
                    outputs[k].value_v = clip(value_v, outputs[k].lowest_v, outputs[k].highest_v)
                else:
                    record_failure(axis_state(law, a), CONTROLLER_OUTPUT, value_v)
                    loop.pending |= TRIP_LAW
