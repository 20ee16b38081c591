"""The law of one tick for all axes: `evaluate` before the drive is written, `update` after.

    x_d ─► pre-filter ─(+)─ e ─► C(z) ─► v ─► limit ─► P̂⁻¹ ─► demand ─► limit, slew ─► u
                        −▲ x

Modes replace the left part: FEEDFORWARD takes v from the reference, RAW takes the demand in volts, OFF and a trip
ramp u to its safe value. Every change of mode continues from the drive in force: what the new mode would do otherwise
is taken off its input as an offset, which dies out with `limits.bump_s`. In closed loop that input is the error, so
that no controller meets a large error as a step. Another controller continues from the command and the error in force.
"""

from __future__ import annotations

from rtloop.hil.native.compiled import jit
from rtloop.law.filters import (
    controller_enter,
    controller_output,
    controller_update,
    fill_prefilter_anew,
    prefilter,
)
from rtloop.law.hysteresis import follow_drive, inverse_drive
from rtloop.law.layout import MAX_ORDER, MAX_PLAYS, MAX_SECTIONS, MAX_TAPS
from rtloop.law.safety import axis_causes, clip, loop_causes, toward, usable
from rtloop.law.watch import watch
from rtloop.signals import Flag, Mode

OFF, RAW, FEEDFORWARD, CLOSED_LOOP = (int(mode) for mode in Mode)
COMMAND_LIMITED = int(Flag.COMMAND_LIMITED)
DRIVE_LIMITED = int(Flag.DRIVE_LIMITED)
SLEW_LIMITED = int(Flag.SLEW_LIMITED)
RAMPING = int(Flag.RAMPING)
HEARTBEAT_LOST = int(Flag.HEARTBEAT_LOST)
NEGLIGIBLE_BUMP = 1e-9
ANOTHER_MODE, ANOTHER_CONTROLLER = 1, 2


@jit
def counts_fit(coefficients):
    """Whether every count of an axis stays within its record: the innermost loops do not look."""
    fit = coefficients.play_count <= MAX_PLAYS and coefficients.order <= MAX_ORDER
    for i in range(MAX_ORDER):
        fit = fit and coefficients.row_stop[i] <= MAX_ORDER
    return fit and coefficients.tap_count <= MAX_TAPS and coefficients.section_count <= MAX_SECTIONS


@jit
def set_mode(axes, loop, mode, at_rest, filled=True):
    """Change the mode; bumplessly, but from zero state `at_rest`, before anything was driven.

    A mode that drives begins with a pre-filter `filled` by the present reference: what it remembers may be volts.
    """
    loop.mode = mode
    for a in range(axes.shape[0]):
        axes[a].entering = 0 if at_rest else ANOTHER_MODE
        if filled and not at_rest and mode != OFF:
            fill_prefilter_anew(axes[a])


@jit
def set_controller(state):
    """Have an axis go on with another controller, whose coefficients have been put in place."""
    if state.entering == 0:
        state.entering = ANOTHER_CONTROLLER


@jit
def reset_trip(loop):
    """Forget the causes of a trip; the mode stays OFF until it is set."""
    loop.trip = 0
    loop.mode = OFF


@jit
def evaluate(coefficients, axes, loop, adc_v, references, conditions):
    """Drives of this tick, in `axes[a].drive_v`, from the inputs in V and the references (µm; V in RAW mode).

    `conditions` is one CONDITIONS record.
    """
    causes = loop_causes(conditions)
    for a in range(axes.shape[0]):
        state = axes[a]
        state.position_um = (adc_v[a] - coefficients[a].offset_v) * coefficients[a].um_per_v
        state.usable = 1 if usable(adc_v[a]) and usable(references[a]) else 0
        causes |= axis_causes(coefficients[a], state, adc_v[a], conditions)
        causes |= watch(coefficients[a], state, loop.mode, adc_v[a], conditions.lateness_us)
    loop.new_trip = causes & ~loop.trip
    loop.trip |= causes
    if loop.trip != 0:
        loop.mode = OFF
    loop.tick_flags = loop.trip | (HEARTBEAT_LOST if conditions.heartbeat_lost != 0 else 0)
    loop.settled = 1
    for a in range(axes.shape[0]):
        loop.tick_flags |= _drive(coefficients[a], axes[a], loop, references[a])
        if axes[a].drive_v != coefficients[a].safe_v:
            loop.settled = 0


@jit
def _drive(coefficients, state, loop, reference):
    """Set the signals and the drive of one axis; returns its flags."""
    last_v, mode = state.drive_v, loop.mode
    if state.usable != 0:
        error_um = prefilter(coefficients, state, reference) - state.position_um
        state.error_um = error_um
    else:
        error_um = reference - state.position_um
        state.error_um = error_um
        if loop.new_trip != 0:  # hold for the tick that trips; the ramp below needs no input
            state.demand_v = last_v
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
            command_um = reference + _bump(coefficients, state, state.applied_command_um - reference)
        else:
            resting_um = coefficients.resting_error * state.applied_command_um
            met_um = error_um - _bump(coefficients, state, error_um - resting_um)
            if state.entering != 0:
                controller_enter(coefficients, state, met_um, state.applied_command_um)
            command_um = controller_output(coefficients, state, met_um)
        state.command_um = command_um
        limited_um = clip(command_um, -coefficients.command_limit_um, coefficients.command_limit_um)
        if limited_um != command_um:
            flags |= COMMAND_LIMITED
        demand_v = inverse_drive(coefficients, state, limited_um)
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
    state.bump = gap if state.entering == ANOTHER_MODE else state.bump * coefficients.bump_decay
    if -NEGLIGIBLE_BUMP < state.bump < NEGLIGIBLE_BUMP:
        state.bump = 0.0
    return state.bump


@jit
def update(coefficients, axes, loop):
    """Advance every memory by the drives really applied."""
    for a in range(axes.shape[0]):
        state = axes[a]
        state.applied_command_um = follow_drive(coefficients[a], state, state.drive_v)
        if loop.mode == CLOSED_LOOP:
            shortfall_um = state.applied_command_um - state.command_um
            tracked_um = coefficients[a].tracking_share * shortfall_um
            controller_update(coefficients[a], state, state.error_um - state.bump, tracked_um)
