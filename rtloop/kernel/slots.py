"""Calls of the laws' functions in the two slots of an axis, controller and feedforward.

A law's exception is a status here: a failure is recorded in the axis's state, and the caller trips the loop.
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
"""Status of a compiled function that returned a value, or none."""
APPLIED = CONTROL.fields["applied_um"][1]  # type: ignore[index]


CONTROLLER_OUTPUT, CONTROLLER_UPDATE, CONTROLLER_ENTER, FEEDFORWARD_OUTPUT, FEEDFORWARD_UPDATE, FEEDFORWARD_ENTER = (
    int(failure) for failure in Failure
)


@jit
def _returned_value(law):
    """Return the number at `law.result`, which the loop's last call of a controller or of a feedforward returned.

    `law` is the LAW record of the loop: laws and axes share the place, so read it before the next call.
    """
    return carray(address_pointer(law.result), 1, np.float64)[0]


@jit_rare
def record_failure(state, failure, value):
    """Record a `Failure` code and the returned value in an axis's state, unless it has a failure already."""
    if state.failed == 0:
        state.failed, state.failed_value = failure, value


@jit
def _call_controller(law, a, function, control_address):
    """Call a function of the controller whose first axis is `a`; its result goes to the address `law.result`.

    Returns its status: OK, NONE, or another if it raised.
    """
    coefficients = law.coefficients + a * law.coefficients_bytes + law.controller_coefficients
    state = law.axes + a * law.axes_bytes + law.controller_state
    return call_law(function, law.result, law.raised, coefficients, state, control_address + a * CONTROL_BYTES)


@jit
def _call_feedforward(law, a, function, result, value):
    """Call a function of the feedforward of axis `a` with `value`; its result goes to the address `result`.

    Returns its status: OK, NONE, or another if it raised.
    """
    coefficients = law.coefficients + a * law.coefficients_bytes + FEEDFORWARD_COEFFICIENTS
    state = law.axes + a * law.axes_bytes + FEEDFORWARD_STATE
    return call_law(function, result, law.raised, coefficients, state, value)


@jit
def controller_output(law, a, coefficients, control_address):
    """Compute the output of the controller whose first axis is `a`. Returns (succeeded, command in µm, not checked).

    `control_address` is `law.controls` for a controller of one axis, `law.together` for a coupled one. A coupled one
    writes its commands to its control record, and the number returned is meaningless. If the law raised, the failure is
    recorded in the axis's state, and (False, NaN) returned.
    """
    status = _call_controller(law, a, law_functions(law, coefficients.controller_law).output, control_address)
    if status in (OK, NONE):
        return True, _returned_value(law)
    record_failure(axis_state(law, a), CONTROLLER_OUTPUT + RAISED, np.nan)
    return False, np.nan


@jit_rare
def controller_enter(law, a, control_address):
    """Set the state of the controller whose first axis is `a` to zeros, and call its function `enter`, if it has one.

    Returns True; False, with the failure recorded in the axis's state, if the law raised.
    """
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
    """Advance the controller whose first axis is `a` by a tick, by its function `update`.

    Returns True; False, with the failure recorded in the axis's state, if the law raised.
    """
    if _call_controller(law, a, law_functions(law, coefficients.controller_law).update, control_address) in (OK, NONE):
        return True
    record_failure(axis_state(law, a), CONTROLLER_UPDATE + RAISED, np.nan)
    return False


@jit
def feedforward_output(law, a, coefficients, state, command_um):
    """Return the drive in V for a command in µm; NaN if the law raised.

    This failure is recorded in `state`, and so is a drive that is not a usable number, which is returned unchanged.
    """
    function = law_functions(law, coefficients.feedforward_law).output
    if _call_feedforward(law, a, function, law.result, command_um) not in (OK, NONE):
        record_failure(state, FEEDFORWARD_OUTPUT + RAISED, np.nan)
        return np.nan
    drive_v = _returned_value(law)
    if not is_usable(drive_v):
        record_failure(state, FEEDFORWARD_OUTPUT, drive_v)
    return drive_v


@jit_rare
def feedforward_enter(law, a, drive_v):
    """Call `enter` of the feedforward of axis `a`, if it has one, with the present drive in V; its state is not zeroed.

    Returns None; if the law raised, the failure is recorded in the axis's state.
    """
    functions = law_functions(law, coefficients_record(law, a).feedforward_law)
    if functions.enter != 0 and _call_feedforward(law, a, functions.enter, law.result, drive_v) not in (OK, NONE):
        record_failure(axis_state(law, a), FEEDFORWARD_ENTER + RAISED, np.nan)


@jit
def feedforward_update(law, a, coefficients, state, drive_v):
    """Advance the feedforward by the applied drive. Returns the command in µm of this drive; NaN if the law raised.

    The command is also written to `applied_um` of the controller's record. A failure, and a command that is not a
    usable number, are recorded in `state`.
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
    """Return whether the coefficients at address `coefficients` keep the rules of law `number` for whole numbers."""
    functions = law_functions(law, number)
    rules = carray(address_pointer(law.rules), functions.first_rule + functions.rule_count, RULE)
    for rule in range(functions.first_rule, functions.first_rule + functions.rule_count):
        limits = rules[rule]
        for i in range(limits.count):
            place = coefficients + limits.offset + i * limits.octets
            octet, word = carray(address_pointer(place), 1, np.uint8), carray(address_pointer(place), 1, np.int64)
            value = np.int64(octet[0]) if limits.octets == 1 else word[0]
            if value < limits.low or value > limits.high or value % limits.step != 0:
                return False
    return True
