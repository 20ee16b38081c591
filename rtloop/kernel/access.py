"""Access of kernels to the records of a loop, by the addresses in its LAW record."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rtloop.foundation.native.compiled import jit
from rtloop.foundation.native.pointers import address_pointer, carray
from rtloop.kernel.interlocks import TRIP
from rtloop.kernel.layout import COEFFICIENTS, CONTROL, CONTROL_SIGNALS, FUNCTIONS, LOOP_STATE, STATE

FEEDFORWARD_COEFFICIENTS, FEEDFORWARD_STATE = COEFFICIENTS.itemsize, STATE.itemsize
CONTROL_BYTES, FUNCTIONS_BYTES = CONTROL.itemsize, FUNCTIONS.itemsize
CONTROL_FIELDS = len(CONTROL_SIGNALS)


class Law(NamedTuple):
    """Fields of a LAW record as values: the compiler can rely on them, because no write of a tick changes them."""

    coefficients: int
    coefficients_bytes: int
    axes: int
    axes_bytes: int
    loop: int
    controls: int
    together: int
    functions: int
    result: int
    raised: int
    trip: int
    controller_coefficients: int
    controller_state: int
    axis_count: int


@jit
def unpack_law(law):
    """Return the fields of the loop's LAW record that kernels use, addresses, sizes and number of axes, as a `Law`."""
    return Law(
        law.coefficients, law.coefficients_bytes, law.axes, law.axes_bytes, law.loop, law.controls, law.together,
        law.functions, law.result, law.raised, law.trip, law.controller_coefficients,
        law.controller_state, int(law.axis_count),
    )  # fmt: skip


@jit
def coefficients_record(law, a):
    """Return the COEFFICIENTS record of axis number `a`, a view; the number is not checked."""
    return carray(address_pointer(law.coefficients + a * law.coefficients_bytes), 1, COEFFICIENTS)[0]


@jit
def axis_state(law, a):
    """Return the STATE record of axis number `a`, a view; the number is not checked."""
    return carray(address_pointer(law.axes + a * law.axes_bytes), 1, STATE)[0]


@jit
def loop_state(law):
    """Return the LOOP_STATE record, common to all axes, a view: mode, causes of a trip, flags of the tick."""
    return carray(address_pointer(law.loop), 1, LOOP_STATE)[0]


@jit
def axis_control(law, a):
    """Return the CONTROL record, a view: the signals for the controller of axis number `a`, which is not checked."""
    return carray(address_pointer(law.controls + a * CONTROL_BYTES), 1, CONTROL)[0]


@jit
def joint_control(law, first, count):
    """Return the signals for the coupled controller of `count` axes from `first` on, a view (CONTROL_FIELDS, count).

    The rows are in the order of CONTROL_SIGNALS, in µm.
    """
    return carray(address_pointer(law.together + first * CONTROL_BYTES), (CONTROL_FIELDS, count), np.float64)


@jit
def law_functions(law, number):
    """Return the FUNCTIONS record of law `number`, a view: functions, sizes of records; the number is not checked."""
    return carray(address_pointer(law.functions + number * FUNCTIONS_BYTES), 1, FUNCTIONS)[0]


@jit
def trip_record(law):
    """Return the TRIP record, a view: axis, cause, law, value and limit of the newest trip's first cause.

    All are 0 before the first trip.
    """
    return carray(address_pointer(law.trip), 1, TRIP)[0]
