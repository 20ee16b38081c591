"""Inputs and outputs beside the sensors and the drives, in volts, which controllers read and set by number.

An output belongs to the controller of one axis. Where that does not set it in a tick, and wherever the loop is not
closed, it is at its safe value; a value beyond its range is brought to the range's end.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rtloop.hil.native.compiled import jit, seldom
from rtloop.hil.native.pointers import address_pointer, carray
from rtloop.law.layout import EXTRA_OUTPUT, MAX_EXTRAS
from rtloop.law.safety import clip, usable


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
def inputs_of(law):
    """What the inputs read in this tick, (MAX_EXTRAS,)."""
    return carray(address_pointer(law.extra_inputs), MAX_EXTRAS, np.float64)


@jit
def outputs_of(law):
    """The outputs, EXTRA_OUTPUT records (MAX_EXTRAS,)."""
    return carray(address_pointer(law.extra_outputs), MAX_EXTRAS, EXTRA_OUTPUT)


@seldom
def hand_in(law, place):
    """Tell a controller, at the address `place`, the inputs, and the outputs at their safe values."""
    told = carray(address_pointer(place), 2 * MAX_EXTRAS, np.float64)
    inputs, outputs = inputs_of(law), outputs_of(law)
    for k in range(law.extra_input_count):
        told[k] = inputs[k]
    for k in range(law.extra_output_count):
        told[MAX_EXTRAS + k] = outputs[k].safe_v


@seldom
def hand_out(law, first, count, place):
    """Take over what the controller of `count` axes from `first` on has set; one that is no number, or 0."""
    told, outputs = carray(address_pointer(place), 2 * MAX_EXTRAS, np.float64), outputs_of(law)
    for k in range(law.extra_output_count):
        if first <= outputs[k].axis < first + count:
            value_v = told[MAX_EXTRAS + k]
            if not usable(value_v):
                return value_v
            outputs[k].value_v = clip(value_v, outputs[k].lowest_v, outputs[k].highest_v)
    return 0.0


@seldom
def make_outputs_safe(law):
    """All of them."""
    outputs = outputs_of(law)
    for k in range(law.extra_output_count):
        outputs[k].value_v = outputs[k].safe_v
