"""The step of one tick for all axes: `evaluate` before the drive is written, `update` after.

        ┌────────── command taps ───────────┐
    x_d ┴─► taps ─► sections ─(+)─ e ─► CONTROLLER ─(+)─ v ─► limit ─► FEEDFORWARD ─► demand ─► limit, slew ─► u
                               −▲ x

CONTROLLER and FEEDFORWARD are functions of laws. Modes replace the left part: FEEDFORWARD takes v from the reference,
RAW takes the demand in volts, OFF and a trip ramp u to its safe value. Every change of mode continues from the drive in
force: the deviation of the new mode is subtracted from its input as an offset, which decays with `limits.bump_s`. In
closed loop that input is the error, so that no controller receives a large error as a step. A new controller continues
from the command and the error in force; an offset of its command, which decays likewise, takes up the remaining gap.
"""

from __future__ import annotations

import numpy as np

from rtloop.foundation.native.compiled import jit, jit_rare
from rtloop.foundation.native.pointers import address_pointer, carray
from rtloop.kernel.access import (
    CONTROL_BYTES,
    CONTROL_FIELDS,
    FEEDFORWARD_COEFFICIENTS,
    axis_control,
    axis_state,
    coefficients_record,
    joint_control,
    law_functions,
    loop_state,
    trip_record,
    unpack_law,
)
from rtloop.kernel.extras import collect_extra_outputs, pass_extra_inputs, set_marks
from rtloop.kernel.interlocks import EVALUATED, NO_AXIS, axis_trip, count_ticks, loop_causes
from rtloop.kernel.layout import COEFFICIENTS, CONTROL_SIGNALS, MAX_COUPLED, MAX_SECTIONS, MAX_TAPS, TAP_LANES
from rtloop.kernel.limits import clip, is_usable, step_toward
from rtloop.kernel.prefilter import filter_reference, refill_prefilter, tap_outputs_um
from rtloop.kernel.slots import (
    CONTROLLER_OUTPUT,
    are_counts_allowed,
    controller_enter,
    controller_output,
    controller_update,
    feedforward_enter,
    feedforward_output,
    feedforward_update,
    record_failure,
)
from rtloop.signals import Failure, Flag, Mode

OFF, RAW, FEEDFORWARD, CLOSED_LOOP = (int(mode) for mode in Mode)
_, COMMAND_LIMITED, DRIVE_LIMITED, SLEW_LIMITED, RAMPING, HEARTBEAT_LOST, *_ = (int(flag) for flag in Flag)
TRIP_LAW = int(Flag.TRIP_LAW)
COMMAND = CONTROL_SIGNALS.index("command_um")
NEGLIGIBLE_BUMP = 1e-9
ANOTHER_MODE, ANOTHER_CONTROLLER = 1, 2
FEEDFORWARD_FAILURES = float(Failure.FEEDFORWARD_OUTPUT)


@jit
def coefficients_fit(law, a, address):
    """Return whether the coefficients of axis `a` at `address` have allowed counts and numbers of laws.

    Each count must stay within its array, each law exist and fit its slot, and the whole numbers of the laws keep
    their rules. The kernels rely on it: they check no count.
    """
    coefficients = carray(address_pointer(address), 1, COEFFICIENTS)[0]
    count = np.int64(coefficients.controller_axes)
    feedforward, controller = coefficients.feedforward_law, coefficients.controller_law
    return (
        0 <= coefficients.tap_count <= MAX_TAPS
        and coefficients.tap_count % TAP_LANES == 0
        and 0 <= coefficients.section_count <= MAX_SECTIONS
        and feedforward < law.law_count
        and controller < law.law_count
        and count <= MAX_COUPLED
        and a + count <= law.axis_count
        and law_functions(law, feedforward).axes == 0
        and are_counts_allowed(law, feedforward, address + FEEDFORWARD_COEFFICIENTS)
        and (
            count == 0
            or (
                law_functions(law, controller).axes == count
                and are_counts_allowed(law, controller, address + law.controller_coefficients)
            )
        )
    )


@jit
def all_coefficients_fit(law):
    """Return whether `coefficients_fit` holds for every axis, and each axis has exactly one controller."""
    owned_axes = 0
    for a in range(law.axis_count):
        count = np.int64(coefficients_record(law, a).controller_axes)
        if (count == 0) != (a < owned_axes) or not coefficients_fit(
            law, a, law.coefficients + a * law.coefficients_bytes
        ):
            return False
        owned_axes = max(owned_axes, a + count)
    return True


@jit
def set_mode(law, mode, at_rest):
    """Change the mode and clear failures of laws.

    The next tick enters the mode without a jump of the drive, except if `at_rest`: the mode then begins at once, as
    RAW and FEEDFORWARD do before the first tick.
    A mode other than OFF, unless `at_rest`, restarts the pre-filter with the next reference: its history may be volts.
    A latched trip is not cleared, and sets mode OFF again in the next tick.
    """
    loop_state(law).mode = mode
    for a in range(law.axis_count):
        state = axis_state(law, a)
        state.entering, state.failed = 0 if at_rest else ANOTHER_MODE, 0
        if not at_rest and mode != OFF:
            refill_prefilter(state)


@jit
def mark_new_controller(law, a):
    """Let axis `a`, and the axes that share its controller, enter a new controller, whose coefficients are in place.

    An axis that is to enter another mode does so instead, which includes the new controller.
    """
    for i in range(a, a + max(np.int64(coefficients_record(law, a).controller_axes), 1)):
        state = axis_state(law, i)
        if state.entering == 0:
            state.entering = ANOTHER_CONTROLLER


@jit
def continue_prefilter(law, a, last_um):
    """Let new taps of axis `a`, which are in place, continue from `last_um`, the last two outputs of the old taps.

    In closed loop the differences go to the decaying offsets of the command and, without sections, of the error; in
    other modes nothing is done.
    """
    coefficients, state = coefficients_record(law, a), axis_state(law, a)
    target_um, added_um = tap_outputs_um(coefficients, state)
    if loop_state(law).mode == CLOSED_LOOP:
        state.command_bump_um += last_um[1] - added_um
        if coefficients.section_count == 0:
            state.bump += target_um - last_um[0]


@jit
def reset_trip(law):
    """Clear the latched causes of a trip, and set mode OFF; the TRIP record stays."""
    loop_state(law).trip = 0
    loop_state(law).mode = OFF


@jit
def evaluate(record, adc_v, references, feeds_um, conditions):
    """Compute `drive_v` of each axis for this tick, from the inputs in V and the references (µm; V in RAW mode).

    `feeds_um` is added to commands in closed loop. `record` is one LAW record, `conditions` one CONDITIONS record.
    States, flags and trip of the loop are set; laws enter a new mode here and advance in `update`.
    """
    law = unpack_law(record)
    loop = loop_state(law)
    causes = loop_causes(conditions) | loop.pending
    loop.pending = 0
    for a in range(law.axis_count):
        coefficients, state = coefficients_record(law, a), axis_state(law, a)
        previous_um = state.position_um + state.error_um
        state.position_um = (adc_v[a] - coefficients.offset_v) * coefficients.um_per_v
        state.usable = 1 if is_usable(adc_v[a]) and is_usable(references[a]) and is_usable(feeds_um[a]) else 0
        count_ticks(coefficients, state, loop.mode, adc_v[a], conditions.lateness_us)
        causes |= axis_trip(coefficients, state, adc_v[a], conditions, EVALUATED)[0]
        target_um, added_um = references[a], 0.0
        if state.usable != 0:
            target_um, added_um = filter_reference(coefficients, state, references[a])
        state.error_um, state.feed_um = target_um - state.position_um, feeds_um[a] + added_um
        if record.extra_output_count != 0:
            set_marks(record, a, target_um - previous_um, state.position_um)
    loop.new_trip = causes & ~loop.trip
    if loop.new_trip != 0:
        _record_trip(law, adc_v, conditions, loop.new_trip)
    loop.trip |= causes
    if loop.trip != 0:
        loop.mode = OFF
    loop.tick_flags = HEARTBEAT_LOST if conditions.heartbeat_lost != 0 else 0
    loop.settled = 1
    if record.extra_count != 0:
        pass_extra_inputs(record)
    for a in range(law.axis_count):
        count = np.int64(coefficients_record(law, a).controller_axes)
        if count > 1:
            _evaluate_coupled(law, a, count, loop, references)
        elif count == 1:
            if loop.mode == CLOSED_LOOP and not _control_axis(law, a):
                _trip_on_law_failure(loop)
            _set_drive(law, a, loop, references[a])
    if record.extra_count != 0:
        collect_extra_outputs(record)
    if loop.new_trip & ~causes != 0:  # a law failed in this tick
        _record_trip(law, adc_v, conditions, loop.new_trip)
    loop.tick_flags |= loop.trip


@jit_rare
def _record_trip(law, adc_v, conditions, causes):
    """Set the TRIP record to the first axis with a cause among `causes`, and to its first cause with value and limit.

    Without such an axis, as for a cause of the whole loop, the axis is NO_AXIS and the rest 0.
    """
    trip = trip_record(law)
    trip.axis, trip.cause, trip.law, trip.value, trip.limit = NO_AXIS, 0, 0, 0.0, 0.0
    for a in range(law.axis_count):
        coefficients = coefficients_record(law, a)
        _, cause, value, limit = axis_trip(coefficients, axis_state(law, a), adc_v[a], conditions, causes)
        if cause != 0:
            trip.axis, trip.cause, trip.value, trip.limit = a, cause, value, limit
            trip.law = coefficients.feedforward_law if limit >= FEEDFORWARD_FAILURES else coefficients.controller_law
            return


@jit
def _trip_on_law_failure(loop):
    """Trip the loop, because a law failed in this tick: set TRIP_LAW and mode OFF in `loop`, the LOOP_STATE record."""
    loop.new_trip |= TRIP_LAW & ~loop.trip
    loop.trip |= TRIP_LAW
    loop.mode = OFF


@jit
def _control_axis(law, a):
    """Set the command of one axis, in its state and its CONTROL record, by its controller, which has no other axes.

    Returns False, with the failure recorded in the state, if its law failed.
    """
    coefficients, state = coefficients_record(law, a), axis_state(law, a)
    _set_control_inputs(
        law, a, coefficients, state, coefficients.resting_error[0] * (state.applied_command_um - state.feed_um)
    )
    is_good = state.entering == 0 or controller_enter(law, a, law.controls)
    succeeded, command_um = controller_output(law, a, coefficients, law.controls)
    is_good = is_good and succeeded
    return _set_command(law, a, coefficients, state, command_um) and is_good


@jit_rare
def _evaluate_coupled(law, first, count, loop, references):
    """Set the commands (controller's output, µm) and the drives (V) of the `count` axes from `first` on, which share a
    controller; if its law fails, trip the loop.
    """
    if loop.mode == CLOSED_LOOP and not _control_coupled(law, first, count):
        _trip_on_law_failure(loop)
    for i in range(first, first + count):
        _set_drive(law, i, loop, references[i])


@jit
def _control_coupled(law, first, count):
    """Set the commands of `count` axes from `first` on, in their states and CONTROL records, by the controller that
    they share.

    Returns False, with the failure recorded in a state, if its law failed. The error at which an axis rests depends on
    the commands of all.
    """
    entering = False
    for i in range(first, first + count):
        coefficients, resting_um = coefficients_record(law, i), 0.0
        for j in range(count):
            coupled_state = axis_state(law, first + j)
            resting_um += coefficients.resting_error[j] * (coupled_state.applied_command_um - coupled_state.feed_um)
        _set_control_inputs(law, i, coefficients, axis_state(law, i), resting_um)
        entering = entering or axis_state(law, i).entering != 0
    _gather_signals(law, first, count)
    is_good = not entering or controller_enter(law, first, law.together)
    succeeded, _ = controller_output(law, first, coefficients_record(law, first), law.together)
    is_good = is_good and succeeded
    commands_um = joint_control(law, first, count)[COMMAND]
    for i in range(count):
        a = first + i
        is_good = _set_command(law, a, coefficients_record(law, a), axis_state(law, a), commands_um[i]) and is_good
    return is_good


@jit
def _gather_signals(law, first, count):
    """Copy the signals of the `count` axes from `first` on into the record of the controller that they share."""
    joint = joint_control(law, first, count)
    for i in range(count):
        signals = carray(address_pointer(law.controls + (first + i) * CONTROL_BYTES), CONTROL_FIELDS, np.float64)
        for field in range(CONTROL_FIELDS):
            joint[field, i] = signals[field]


@jit
def _set_control_inputs(law, i, coefficients, state, resting_um):
    """Set the signals of axis `i` for its controller, which rests at an error of `resting_um`.

    The decaying offset of a bumpless entry is subtracted from the error, and the reference agrees with the result; the
    command is the one applied last, without the part from the reference.
    """
    control = axis_control(law, i)
    entry_error_um = state.error_um - _bump_offset(coefficients, state, state.error_um - resting_um)
    control.reference_um, control.position_um, control.error_um = (
        state.position_um + entry_error_um,
        state.position_um,
        entry_error_um,
    )
    control.command_um = control.applied_um = state.applied_command_um - state.feed_um


@jit
def _set_command(law, i, coefficients, state, command_um):
    """Set the command of an axis: the controller's command, its decaying offset, and the part from the reference.

    The CONTROL record gets the command without the part from the reference. Returns True; False, with the failure
    recorded, for a command that is not a usable number.
    """
    gap_um = state.applied_command_um - state.feed_um - command_um
    state.command_bump_um = _decayed_offset(coefficients, state.command_bump_um, state.entering != 0, gap_um)
    axis_control(law, i).command_um = command_um + state.command_bump_um
    state.command_um = axis_control(law, i).command_um + state.feed_um
    if not is_usable(command_um):
        record_failure(state, CONTROLLER_OUTPUT, command_um)
        return False
    return True


@jit
def _set_drive(law, a, loop, reference):
    """Set drive, demand and command of one axis, and add its flags to the loop's.

    The loop's `settled` becomes 0 if the drive is not the axis's safe value.
    """
    coefficients, state = coefficients_record(law, a), axis_state(law, a)
    loop.tick_flags |= _compute_drive(law, a, loop, coefficients, state, reference)
    if state.drive_v != coefficients.safe_v:
        loop.settled = 0


@jit
def _compute_drive(law, a, loop, coefficients, state, reference):
    """Set drive, demand and command of one axis. Returns the Flag bits of its limits, RAMPING if it ramps or is held.

    A feedforward that fails trips the loop. In a tick that trips, the drive is held if the axis has an unusable input
    or a failed law.
    """
    last_v, mode = state.drive_v, loop.mode
    if loop.new_trip != 0 and (state.usable == 0 or state.failed != 0):
        state.demand_v = last_v  # the drive is held in the tick that trips; the ramp below needs no input
        return RAMPING
    if mode == OFF:
        state.drive_v = step_toward(last_v, coefficients.safe_v, coefficients.trip_slew_v_per_tick)
        state.demand_v = coefficients.safe_v
        state.command_um = state.applied_command_um
        return 0 if state.drive_v == coefficients.safe_v else RAMPING
    flags = 0
    if mode == RAW:
        state.command_um = state.applied_command_um
        demand_v = reference + _bump_offset(coefficients, state, last_v - reference)
    else:
        if mode == FEEDFORWARD:
            state.command_um = reference + _bump_offset(coefficients, state, state.applied_command_um - reference)
        command_um = state.command_um
        limited_um = clip(command_um, -coefficients.command_limit_um, coefficients.command_limit_um)
        if limited_um != command_um:
            flags |= COMMAND_LIMITED
        if state.entering != 0:
            feedforward_enter(law, a, last_v)
        demand_v = feedforward_output(law, a, coefficients, state, limited_um)
        if state.failed != 0:
            _trip_on_law_failure(loop)
            state.demand_v = last_v
            return RAMPING
    state.entering, state.demand_v = 0, demand_v
    allowed_v = clip(demand_v, coefficients.drive_min_v, coefficients.drive_max_v)
    if allowed_v != demand_v:
        flags |= DRIVE_LIMITED
    drive_v = step_toward(last_v, allowed_v, coefficients.slew_v_per_tick)
    state.drive_v = drive_v
    if drive_v != allowed_v:
        flags |= SLEW_LIMITED
    return flags


@jit
def _bump_offset(coefficients, state, gap):
    """Advance and return the decaying offset (µm, or V in RAW) that makes a new mode continue from the present drive.

    It restarts at `gap` in the tick that enters the mode.
    """
    state.bump = _decayed_offset(coefficients, state.bump, state.entering == ANOTHER_MODE, gap)
    return state.bump


@jit
def _decayed_offset(coefficients, offset, restarts, gap):
    """Return an offset one tick later: `gap` if it restarts, else times `bump_decay`; 0 once it is negligible."""
    offset = gap if restarts else offset * coefficients.bump_decay
    return 0.0 if -NEGLIGIBLE_BUMP < offset < NEGLIGIBLE_BUMP else offset


@jit
def update(record):
    """Advance the memory of all laws by the drives that were applied, and set each axis's applied command.

    Controllers advance in closed loop alone. A law that fails trips the loop in the next tick.
    """
    law = unpack_law(record)
    loop = loop_state(law)
    for a in range(law.axis_count):
        coefficients = coefficients_record(law, a)
        count = np.int64(coefficients.controller_axes)
        if count != 0:
            _update_feedforward(law, a, loop, coefficients)
            if count > 1:
                _update_coupled(law, a, count, loop)
            elif loop.mode == CLOSED_LOOP and not controller_update(law, a, coefficients, law.controls):
                loop.pending |= TRIP_LAW


@jit_rare
def _update_coupled(law, first, count, loop):
    """Advance the shared controller of axes `first` … `first` + `count` − 1, and the feedforwards of all but the first.

    The controller advances in closed loop only. A failure adds TRIP_LAW to `loop.pending`, which trips the loop in the
    next tick.
    """
    for i in range(first + 1, first + count):
        _update_feedforward(law, i, loop, coefficients_record(law, i))
    if loop.mode == CLOSED_LOOP:
        _gather_signals(law, first, count)
        if not controller_update(law, first, coefficients_record(law, first), law.together):
            loop.pending |= TRIP_LAW


@jit
def _update_feedforward(law, a, loop, coefficients):
    """Advance the feedforward of one axis, and set the applied command for its controller.

    A failure trips the loop in the next tick.
    """
    state = axis_state(law, a)
    applied_um = feedforward_update(law, a, coefficients, state, state.drive_v)
    if is_usable(applied_um):
        state.applied_command_um = applied_um
        axis_control(law, a).applied_um = applied_um - state.feed_um
    else:
        loop.pending |= TRIP_LAW
