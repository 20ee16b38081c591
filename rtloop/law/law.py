"""The law of one tick for all axes: `evaluate` before the drive is written, `update` after.

        ┌────────── command taps ───────────┐
    x_d ┴─► taps ─► sections ─(+)─ e ─► CONTROLLER ─(+)─ v ─► limit ─► FEEDFORWARD ─► demand ─► limit, slew ─► u
                               −▲ x

The two in capitals are plug-ins, of which this file knows nothing but how to call them. Modes replace the left part:
FEEDFORWARD takes v from the reference, RAW takes the demand in volts, OFF and a trip ramp u to its safe value. Every
change of mode continues from the drive in force: what the new mode would do otherwise is taken off its input as an
offset, which dies out with `limits.bump_s`. In closed loop that input is the error, so that no controller meets a large
error as a step. Another controller continues from the command and the error in force; what it cannot continue by itself
is an offset of its command, which dies out likewise.
"""

from __future__ import annotations

import numpy as np

from rtloop.hil.native.compiled import jit, seldom
from rtloop.hil.native.pointers import address_pointer, carray
from rtloop.law.access import (
    CONTROL_BYTES,
    CONTROL_FIELDS,
    FEEDFORWARD_COEFFICIENTS,
    coefficients_of,
    control_of,
    functions_of,
    loop_of,
    opened,
    state_of,
    together_of,
)
from rtloop.law.extras import hand_in, hand_out
from rtloop.law.layout import COEFFICIENTS, MAX_COUPLED, MAX_SECTIONS, MAX_TAPS, TAP_LANES, TOLD
from rtloop.law.prefilter import fill_prefilter_anew, filtered, prefilter
from rtloop.law.safety import axis_causes, clip, loop_causes, toward, usable
from rtloop.law.slots import (
    CONTROLLER_OUTPUT,
    admitted,
    controller_enter,
    controller_output,
    controller_update,
    feedforward_enter,
    feedforward_output,
    feedforward_update,
    note_failure,
)
from rtloop.law.watch import watch
from rtloop.signals import Flag, Mode

OFF, RAW, FEEDFORWARD, CLOSED_LOOP = (int(mode) for mode in Mode)
COMMAND_LIMITED = int(Flag.COMMAND_LIMITED)
DRIVE_LIMITED = int(Flag.DRIVE_LIMITED)
SLEW_LIMITED = int(Flag.SLEW_LIMITED)
RAMPING = int(Flag.RAMPING)
HEARTBEAT_LOST = int(Flag.HEARTBEAT_LOST)
TRIP_LAW = int(Flag.TRIP_LAW)
COMMAND = TOLD.index("command_um")
NEGLIGIBLE_BUMP = 1e-9
ANOTHER_MODE, ANOTHER_CONTROLLER = 1, 2


@jit
def fits(law, a, address):
    """Whether every count in the coefficients of axis `a` at `address` stays within its record: no kernel looks."""
    coefficients = carray(address_pointer(address), 1, COEFFICIENTS)[0]
    count = np.int64(coefficients.controller_axes)
    if coefficients.tap_count < 0 or coefficients.tap_count > MAX_TAPS or coefficients.tap_count % TAP_LANES != 0:
        return False
    if coefficients.section_count < 0 or coefficients.section_count > MAX_SECTIONS:
        return False
    if coefficients.feedforward_law >= law.law_count or coefficients.controller_law >= law.law_count:
        return False
    if count > MAX_COUPLED or a + count > law.axis_count or functions_of(law, coefficients.feedforward_law).axes != 0:
        return False
    if count != 0 and functions_of(law, coefficients.controller_law).axes != count:
        return False
    if not admitted(law, coefficients.feedforward_law, address + FEEDFORWARD_COEFFICIENTS):
        return False
    return count == 0 or admitted(law, coefficients.controller_law, address + law.controller_coefficients)


@jit
def all_fit(law):
    """Whether `fits` holds for every axis, and each has a controller, its own or that of one before it."""
    owned_axes = 0
    for a in range(law.axis_count):
        count = np.int64(coefficients_of(law, a).controller_axes)
        if (count == 0) != (a < owned_axes) or not fits(law, a, law.coefficients + a * law.coefficients_bytes):
            return False
        owned_axes = max(owned_axes, a + count)
    return True


@jit
def set_mode(law, mode, at_rest):
    """Change the mode; bumplessly, but from zero state `at_rest`, before anything was driven.

    A mode that drives begins with a pre-filter filled by the present reference: what it remembers may be volts.
    """
    loop_of(law).mode = mode
    for a in range(law.axis_count):
        state = state_of(law, a)
        state.entering, state.failed = 0 if at_rest else ANOTHER_MODE, 0
        if not at_rest and mode != OFF:
            fill_prefilter_anew(state)


@jit
def set_controller(law, a):
    """Have axis `a`, and those that share its controller, go on with another one, whose coefficients are in place."""
    for i in range(a, a + max(np.int64(coefficients_of(law, a).controller_axes), 1)):
        state = state_of(law, i)
        if state.entering == 0:
            state.entering = ANOTHER_CONTROLLER


@jit
def set_prefilter(law, a, last_um):
    """Have axis `a` go on with other taps, which are in place, from what those before made of the last references."""
    coefficients, state = coefficients_of(law, a), state_of(law, a)
    target_um, added_um = filtered(coefficients, state)
    if loop_of(law).mode == CLOSED_LOOP:
        state.command_bump_um += last_um[1] - added_um
        if coefficients.section_count == 0:
            state.bump += target_um - last_um[0]


@jit
def reset_trip(law):
    """Forget the causes of a trip; the mode stays OFF until it is set."""
    loop_of(law).trip = 0
    loop_of(law).mode = OFF


@jit
def evaluate(record, adc_v, references, feeds_um, conditions):
    """Drives of this tick, in `drive_v` of each axis, from the inputs in V and the references (µm; V in RAW mode).

    `feeds_um` is added to commands in closed loop. `record` is one LAW record, `conditions` one CONDITIONS record.
    """
    law = opened(record)
    loop = loop_of(law)
    causes = loop_causes(conditions) | loop.pending
    loop.pending = 0
    for a in range(law.axis_count):
        coefficients, state = coefficients_of(law, a), state_of(law, a)
        state.position_um = (adc_v[a] - coefficients.offset_v) * coefficients.um_per_v
        state.usable = 1 if usable(adc_v[a]) and usable(references[a]) and usable(feeds_um[a]) else 0
        causes |= axis_causes(coefficients, state, adc_v[a], conditions)
        causes |= watch(coefficients, state, loop.mode, adc_v[a], conditions.lateness_us)
        target_um, added_um = references[a], 0.0
        if state.usable != 0:
            target_um, added_um = prefilter(coefficients, state, references[a])
        state.error_um, state.feed_um = target_um - state.position_um, feeds_um[a] + added_um
    loop.new_trip = causes & ~loop.trip
    loop.trip |= causes
    if loop.trip != 0:
        loop.mode = OFF
    loop.tick_flags = HEARTBEAT_LOST if conditions.heartbeat_lost != 0 else 0
    loop.settled = 1
    if record.extra_count != 0:
        hand_in(record)
    for a in range(law.axis_count):
        count = np.int64(coefficients_of(law, a).controller_axes)
        if count > 1:
            _evaluate_together(law, a, count, loop, references)
        elif count == 1:
            if loop.mode == CLOSED_LOOP and not _control(law, a):
                _trip_by_law(loop)
            _drive(law, a, loop, references[a])
    if record.extra_count != 0:
        hand_out(record)
    loop.tick_flags |= loop.trip


@jit
def _trip_by_law(loop):
    """A plug-in failed in this tick."""
    loop.new_trip |= TRIP_LAW & ~loop.trip
    loop.trip |= TRIP_LAW
    loop.mode = OFF


@jit
def _control(law, a):
    """Command of one axis that has a controller of its own; False where that failed."""
    coefficients, state = coefficients_of(law, a), state_of(law, a)
    _tell(law, a, coefficients, state, coefficients.resting_error[0] * (state.applied_command_um - state.feed_um))
    is_good = state.entering == 0 or controller_enter(law, a, law.controls)
    succeeded, command_um = controller_output(law, a, coefficients, law.controls)
    is_good = is_good and succeeded
    return _command(law, a, coefficients, state, command_um) and is_good


@seldom
def _evaluate_together(law, first, count, loop, references):
    """The axes from `first` on, which share a controller."""
    if loop.mode == CLOSED_LOOP and not _control_together(law, first, count):
        _trip_by_law(loop)
    for i in range(first, first + count):
        _drive(law, i, loop, references[i])


@jit
def _control_together(law, first, count):
    """Commands of axes that share a controller; False where it failed.

    Each rests at an error that depends on the commands of all.
    """
    entering = False
    for i in range(first, first + count):
        coefficients, resting_um = coefficients_of(law, i), 0.0
        for j in range(count):
            coupled_state = state_of(law, first + j)
            resting_um += coefficients.resting_error[j] * (coupled_state.applied_command_um - coupled_state.feed_um)
        _tell(law, i, coefficients, state_of(law, i), resting_um)
        entering = entering or state_of(law, i).entering != 0
    _gather(law, first, count)
    is_good = not entering or controller_enter(law, first, law.together)
    succeeded, _ = controller_output(law, first, coefficients_of(law, first), law.together)
    is_good = is_good and succeeded
    commands_um = together_of(law, first, count)[COMMAND]
    for i in range(count):
        a = first + i
        is_good = _command(law, a, coefficients_of(law, a), state_of(law, a), commands_um[i]) and is_good
    return is_good


@jit
def _gather(law, first, count):
    """What the axes from `first` on are told, as the controller that they share finds it."""
    joint = together_of(law, first, count)
    for i in range(count):
        signals = carray(address_pointer(law.controls + (first + i) * CONTROL_BYTES), CONTROL_FIELDS, np.float64)
        for field in range(CONTROL_FIELDS):
            joint[field, i] = signals[field]


@jit
def _tell(law, i, coefficients, state, resting_um):
    """What a controller meets on axis `i`, where it rests at an error of `resting_um`."""
    control = control_of(law, i)
    entry_error_um = state.error_um - _bump(coefficients, state, state.error_um - resting_um)
    control.reference_um, control.position_um, control.error_um = (
        state.position_um + entry_error_um,
        state.position_um,
        entry_error_um,
    )
    control.command_um = control.applied_um = state.applied_command_um - state.feed_um


@jit
def _command(law, i, coefficients, state, command_um):
    """Note the command of an axis, with what it still owes to the one before; False where it is none.

    What the reference adds to it is none of the controller's, which is told of its own part alone.
    """
    gap_um = state.applied_command_um - state.feed_um - command_um
    state.command_bump_um = _died(coefficients, state.command_bump_um, state.entering != 0, gap_um)
    control_of(law, i).command_um = command_um + state.command_bump_um
    state.command_um = control_of(law, i).command_um + state.feed_um
    if not usable(command_um):
        note_failure(state, CONTROLLER_OUTPUT, command_um)
        return False
    return True


@jit
def _drive(law, a, loop, reference):
    """Set the signals and the drive of one axis, and its flags."""
    coefficients, state = coefficients_of(law, a), state_of(law, a)
    loop.tick_flags |= _driven(law, a, loop, coefficients, state, reference)
    if state.drive_v != coefficients.safe_v:
        loop.settled = 0


@jit
def _driven(law, a, loop, coefficients, state, reference):
    last_v, mode = state.drive_v, loop.mode
    if loop.new_trip != 0 and (state.usable == 0 or state.failed != 0):
        state.demand_v = last_v  # hold for the tick that trips; the ramp below needs no input
        return RAMPING
    if mode == OFF:
        state.drive_v = toward(last_v, coefficients.safe_v, coefficients.trip_slew_v_per_tick)
        state.demand_v = coefficients.safe_v
        state.command_um = state.applied_command_um
        return 0 if state.drive_v == coefficients.safe_v else RAMPING
    flags = 0
    if mode == RAW:
        state.command_um = state.applied_command_um
        demand_v = reference + _bump(coefficients, state, last_v - reference)
    else:
        if mode == FEEDFORWARD:
            state.command_um = reference + _bump(coefficients, state, state.applied_command_um - reference)
        command_um = state.command_um
        limited_um = clip(command_um, -coefficients.command_limit_um, coefficients.command_limit_um)
        if limited_um != command_um:
            flags |= COMMAND_LIMITED
        if state.entering != 0:
            feedforward_enter(law, a, last_v)
        demand_v = feedforward_output(law, a, coefficients, state, limited_um)
        if state.failed != 0:
            _trip_by_law(loop)
            state.demand_v = last_v
            return RAMPING
    state.entering, state.demand_v = 0, demand_v
    allowed_v = clip(demand_v, coefficients.drive_min_v, coefficients.drive_max_v)
    if allowed_v != demand_v:
        flags |= DRIVE_LIMITED
    drive_v = toward(last_v, allowed_v, coefficients.slew_v_per_tick)
    state.drive_v = drive_v
    if drive_v != allowed_v:
        flags |= SLEW_LIMITED
    return flags


@jit
def _bump(coefficients, state, gap):
    """The decaying offset that makes a new mode continue from where the old one was."""
    state.bump = _died(coefficients, state.bump, state.entering == ANOTHER_MODE, gap)
    return state.bump


@jit
def _died(coefficients, offset, anew, gap):
    """An offset a tick later, or `anew` from a gap."""
    offset = gap if anew else offset * coefficients.bump_decay
    return 0.0 if -NEGLIGIBLE_BUMP < offset < NEGLIGIBLE_BUMP else offset


@jit
def update(record):
    """Advance every memory by the drives really applied."""
    law = opened(record)
    loop = loop_of(law)
    for a in range(law.axis_count):
        coefficients = coefficients_of(law, a)
        count = np.int64(coefficients.controller_axes)
        if count != 0:
            _follow(law, a, loop, coefficients)
            if count > 1:
                _update_together(law, a, count, loop)
            elif loop.mode == CLOSED_LOOP and not controller_update(law, a, coefficients, law.controls):
                loop.pending |= TRIP_LAW


@seldom
def _update_together(law, first, count, loop):
    """The other axes that share the controller of axis `first`, and then that."""
    for i in range(first + 1, first + count):
        _follow(law, i, loop, coefficients_of(law, i))
    if loop.mode == CLOSED_LOOP:
        _gather(law, first, count)
        if not controller_update(law, first, coefficients_of(law, first), law.together):
            loop.pending |= TRIP_LAW


@jit
def _follow(law, a, loop, coefficients):
    """Advance the feedforward of one axis, and say to its controller what was applied."""
    state = state_of(law, a)
    applied_um = feedforward_update(law, a, coefficients, state, state.drive_v)
    if usable(applied_um):
        state.applied_command_um = applied_um
        control_of(law, a).applied_um = applied_um - state.feed_um
    else:
        loop.pending |= TRIP_LAW
