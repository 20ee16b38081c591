"""Interlocks with memory: readings that stand still, errors that last, swings that do not end, ticks late in a row.

Like all interlocks they look at recorded inputs and at the law's own state, and at nothing else.
"""

from __future__ import annotations

from rtloop.foundation.native.compiled import jit
from rtloop.signals import Flag, Mode

CLOSED_LOOP = int(Mode.CLOSED_LOOP)
FROZEN = int(Flag.TRIP_FROZEN)
TRACKING = int(Flag.TRIP_TRACKING)
OSCILLATION = int(Flag.TRIP_OSCILLATION)
LATE = int(Flag.TRIP_LATE)


@jit
def lasting_causes(coefficients, state, mode, adc_v, lateness_us):
    """Flag bits of what one axis has been doing for too long; limits of 0 ticks or swings are off."""
    causes = 0
    if coefficients.frozen_ticks > 0 and _is_frozen(coefficients, state, adc_v):
        causes |= FROZEN
    if coefficients.late_ticks > 0:
        state.late_count = state.late_count + 1 if lateness_us > coefficients.late_us else 0
        if state.late_count >= coefficients.late_ticks:
            causes |= LATE
    if mode != CLOSED_LOOP:
        state.tracking_count = state.swing_count = state.swing_age = 0
        state.swing_extreme_um = state.position_um
        return causes
    if coefficients.tracking_ticks > 0:
        error_um = state.error_um if state.error_um >= 0.0 else -state.error_um
        state.tracking_count = state.tracking_count + 1 if error_um > coefficients.tracking_error_um else 0
        if state.tracking_count >= coefficients.tracking_ticks:
            causes |= TRACKING
    if coefficients.oscillation_swings > 0:
        _count_swings(coefficients, state)
        if state.swing_count >= coefficients.oscillation_swings:
            causes |= OSCILLATION
    return causes


@jit
def _is_frozen(coefficients, state, adc_v):
    """The same reading for long enough, although the drive has moved meanwhile."""
    if adc_v != state.frozen_adc_v:
        state.frozen_adc_v, state.frozen_from_v, state.frozen_count = adc_v, state.drive_v, 0
        return False
    state.frozen_count += 1
    moved_v = state.drive_v - state.frozen_from_v
    if moved_v < 0.0:
        moved_v = -moved_v
    return state.frozen_count >= coefficients.frozen_ticks and moved_v > coefficients.frozen_drive_v


@jit
def _count_swings(coefficients, state):
    """Count reversals of the position by more than `oscillation_um`, each within `swing_ticks` of the last."""
    position_um, extreme_um = state.position_um, state.swing_extreme_um
    state.swing_age += 1
    if state.swing_age > coefficients.swing_ticks:
        state.swing_count = 0
    if state.swing_direction >= 0:
        if position_um > extreme_um:
            state.swing_extreme_um = position_um
        elif position_um < extreme_um - coefficients.oscillation_um:
            _begin_swing(state, -1)
    elif position_um < extreme_um:
        state.swing_extreme_um = position_um
    elif position_um > extreme_um + coefficients.oscillation_um:
        _begin_swing(state, 1)


@jit
def _begin_swing(state, direction):
    state.swing_direction = direction
    state.swing_extreme_um = state.position_um
    state.swing_count += 1
    state.swing_age = 0
