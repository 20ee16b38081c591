"""The two places of a law that plug-ins fill: calls of their functions, on records of their own.

Whatever a plug-in returns or raises is a number here: a failure is noted with the axis, and the caller trips.
"""

from __future__ import annotations

import numpy as np

from rtloop.foundation.native.compiled import jit, jit_rare
from rtloop.foundation.native.pointers import address_pointer, call_law, carray
from rtloop.kernel.access import (
    CONTROL_BYTES,
    FEEDFORWARD_COEFFICIENTS,
    FEEDFORWARD_STATE,
    axis_state,
    coefficients_record,
    law_functions,
)
from rtloop.kernel.layout import CONTROL, RULE
from rtloop.kernel.limits import is_usable
from rtloop.signals import RAISED, Failure

OK, NONE = 0, -2
APPLIED = CONTROL.fields["applied_um"][1]  # type: ignore[index]
"""Status of a compiled function that returned a value, or none."""


CONTROLLER_OUTPUT, CONTROLLER_UPDATE, CONTROLLER_ENTER = (
    int(Failure.CONTROLLER_OUTPUT), int(Failure.CONTROLLER_UPDATE), int(Failure.CONTROLLER_ENTER)
)  # fmt: skip
FEEDFORWARD_OUTPUT, FEEDFORWARD_UPDATE, FEEDFORWARD_ENTER = (
    int(Failure.FEEDFORWARD_OUTPUT), int(Failure.FEEDFORWARD_UPDATE), int(Failure.FEEDFORWARD_ENTER)
)  # fmt: skip


@jit
def _last_result(law):
    """What the last call returned."""
    return carray(address_pointer(law.result), 1, np.float64)[0]


@jit_rare
def record_failure(state, failure, value):
    """The first failure of an axis since it was entered is the one that is told."""
    if state.failed == 0:
        state.failed, state.failed_value = failure, value


@jit
def _call_controller(law, a, function, control_address):
    coefficients = law.coefficients + a * law.coefficients_bytes + law.controller_coefficients
    state = law.axes + a * law.axes_bytes + law.controller_state
    return call_law(function, law.result, law.raised, coefficients, state, control_address + a * CONTROL_BYTES)


@jit
def _call_feedforward(law, a, function, result, value):
    coefficients = law.coefficients + a * law.coefficients_bytes + FEEDFORWARD_COEFFICIENTS
    state = law.axes + a * law.axes_bytes + FEEDFORWARD_STATE
    return call_law(function, result, law.raised, coefficients, state, value)


@jit
def controller_output(law, a, coefficients, control_address):
    """Whether the controller whose first axis is `a` came to its end, and what it returned.

    `told` is where what it is told begins, for all axes: `law.controls` or `law.together`.
    """
    status = _call_controller(law, a, law_functions(law, coefficients.controller_law).output, control_address)
    if status in (OK, NONE):
        return True, _last_result(law)
    record_failure(axis_state(law, a), CONTROLLER_OUTPUT + RAISED, np.nan)
    return False, np.nan


@jit_rare
def controller_enter(law, a, control_address):
    """Have the controller whose first axis is `a`, its state at zero, go on from a command; False where it failed."""
    functions = law_functions(law, coefficients_record(law, a).controller_law)
    state = carray(
        address_pointer(law.axes + a * law.axes_bytes + law.controller_state), functions.state_bytes, np.uint8
    )
    for i in range(functions.state_bytes):
        state[i] = 0
    if functions.enter == 0 or _call_controller(law, a, functions.enter, control_address) in (OK, NONE):
        return True
    record_failure(axis_state(law, a), CONTROLLER_ENTER + RAISED, np.nan)
    return False


@jit
def controller_update(law, a, coefficients, control_address):
    """Advance the controller whose first axis is `a`; False where it failed."""
    if _call_controller(law, a, law_functions(law, coefficients.controller_law).update, control_address) in (OK, NONE):
        return True
    record_failure(axis_state(law, a), CONTROLLER_UPDATE + RAISED, np.nan)
    return False


@jit
def feedforward_output(law, a, coefficients, state, command_um):
    """Drive in V for a command in µm; a failure is noted."""
    function = law_functions(law, coefficients.feedforward_law).output
    if _call_feedforward(law, a, function, law.result, command_um) not in (OK, NONE):
        record_failure(state, FEEDFORWARD_OUTPUT + RAISED, np.nan)
        return np.nan
    drive_v = _last_result(law)
    if not is_usable(drive_v):
        record_failure(state, FEEDFORWARD_OUTPUT, drive_v)
    return drive_v


@jit_rare
def feedforward_enter(law, a, drive_v):
    """The feedforward takes over at `drive_v`."""
    functions = law_functions(law, coefficients_record(law, a).feedforward_law)
    if functions.enter != 0 and _call_feedforward(law, a, functions.enter, law.result, drive_v) not in (OK, NONE):
        record_failure(axis_state(law, a), FEEDFORWARD_ENTER + RAISED, np.nan)


@jit
def feedforward_update(law, a, coefficients, state, drive_v):
    """Advance the feedforward by the drive applied: the command in µm that this was; NaN where it failed.

    It goes straight to where the controller finds it.
    """
    function = law_functions(law, coefficients.feedforward_law).update
    place = law.controls + a * CONTROL_BYTES + APPLIED
    if _call_feedforward(law, a, function, place, drive_v) not in (OK, NONE):
        record_failure(state, FEEDFORWARD_UPDATE + RAISED, np.nan)
        return np.nan
    applied_um = carray(address_pointer(place), 1, np.float64)[0]
    if not is_usable(applied_um):
        record_failure(state, FEEDFORWARD_UPDATE, applied_um)
    return applied_um


@jit_rare
def are_counts_allowed(law, number, coefficients):
    """Whether all counts and indices in a law's coefficients, at an address, are what its kernels can work with."""
    functions = law_functions(law, number)
    rules = carray(address_pointer(law.rules), functions.first_rule + functions.rule_count, RULE)
    for rule in range(functions.first_rule, functions.first_rule + functions.rule_count):
        limits = rules[rule]
        for i in range(limits.count):
            place = coefficients + limits.offset + i * limits.octets
            if limits.octets == 1:
                value = np.int64(carray(address_pointer(place), 1, np.uint8)[0])
            else:
                value = carray(address_pointer(place), 1, np.int64)[0]
            if value < limits.low or value > limits.high or value % limits.step != 0:
                return False
    return True
