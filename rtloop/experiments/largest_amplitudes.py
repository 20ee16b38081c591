"""Largest amplitudes with which an experiment neither trips the loop nor meets a limit.

A command is larger than the reference by the overshoot of the controller, and a position larger than the command by the
resonance: the factors of the linear model divide the range of slow commands (`Setting.reach`).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from rtloop.experiments.setting import Bound, Setting
from rtloop.hysteresis.reach import can_hold

UNKNOWN_PEAK, MIN_PEAK = 1.4, 1.1
"""Command per step of the reference without a model, and the least value used, as the hysteresis adds to it."""
FEEDFORWARD_PEAK = 1.02
"""Factor for the dead band, which the inverse may add to the command."""


def largest_command(setting: Setting) -> Bound:
    """Return the largest amplitude of a slow sine in mode feedforward, µm, with the limit that sets it.

    It is `Setting.reach` divided by FEEDFORWARD_PEAK, because the inverse may add the dead band to the command.
    """
    return setting.reach.divided(FEEDFORWARD_PEAK, "with the dead band, the command is up to", "the reference")


def largest_step_up(setting: Setting) -> Bound:
    """Return the largest height ≥ 0 of a step of the reference up from 0 and back, µm, with the limit that sets it.

    With a drive of one sign, the step starts at the middle of the reachable range instead of 0.
    """
    return _largest_step_towards(setting, 1.0)


def largest_step_down(setting: Setting) -> Bound:
    """Return the largest height ≥ 0 of a step of the reference down from 0 and back, µm, with the limit that sets it.

    With a drive of one sign, the step starts at the middle of the reachable range instead of 0.
    """
    return _largest_step_towards(setting, -1.0)


def _largest_step_towards(setting: Setting, direction: float) -> Bound:
    """Return the largest height ≥ 0, µm, of a step of the reference from 0 and back, with the limit that sets it.

    The step goes up for `direction` 1, down for −1. A step towards the shorter side of the drive's range, or down if
    both sides are equal, is computed after the largest step to the other side, which the hysteresis remembers. With a
    drive of one sign, steps start at the middle of the reachable range, and have equal room to both sides.
    """
    axis, model, drive_range_v = setting.axis, setting.model, setting.drive_range_v
    peak = max((model and model.step_peak) or UNKNOWN_PEAK, MIN_PEAK)
    modelled_reversal = None if model is None else model.step_reversal
    reversal = UNKNOWN_PEAK - 1 if modelled_reversal is None else max(modelled_reversal, MIN_PEAK - 1)
    if setting.is_one_sided:
        return setting.reach.divided(max(peak, reversal), "the command of a step is up to", "the step")
    sign = direction * math.copysign(1.0, setting.um_per_v)
    earlier_commands_um = np.zeros(1)
    if sign * sum(drive_range_v) < 0 or (sum(drive_range_v) == 0 and direction < 0):
        opposite_um = _largest_step_towards(setting, -direction).magnitude
        earlier_commands_um = -opposite_um * np.array([peak, -reversal])
    bound = min(
        Bound(axis.limits.command_um, f"limits.command_um = {axis.limits.command_um:g}"),
        setting.trip_towards(direction),
    ).divided(peak, "the command of a step is up to", "the step")
    actuator = axis.feedforward.actuator()

    def is_held(height_um: float) -> bool:
        """Whether the drive stays within its range in a step of this height and back, after the earlier commands."""
        commands_um = np.concatenate([earlier_commands_um, height_um * np.array([peak, -reversal])])
        return can_hold(actuator, direction * commands_um, *drive_range_v)

    held_um = largest_true(is_held, bound.magnitude)
    peak_um = np.append(earlier_commands_um, held_um * (1 + 1e-6) * peak)
    if can_hold(actuator, direction * peak_um, *drive_range_v):
        key = setting.largest_drive(-sign)[1]
        effect = f"the command of a step back to 0 goes beyond 0 by {reversal:.3g} times the height of the step"
    else:
        key = setting.largest_drive(sign)[1]
        effect = f"the command of a step is up to {peak:.3g} times as large as the step"
    return min(bound, Bound(held_um, f"{key} ({effect})"))


def largest_sine(setting: Setting) -> Bound:
    """Return the largest amplitude of a sine of the reference at any frequency, µm, with the limit that sets it."""
    peak = max((setting.model and setting.model.sine_peak) or UNKNOWN_PEAK, MIN_PEAK)
    return setting.reach.divided(peak, "the command of a sine is up to", "the sine")


def largest_swept_sine(setting: Setting) -> Bound:
    """Return the largest amplitude of a sine at any frequency, µm, with the limit that sets it.

    The amplitude holds for the command without a controller and for the reference in closed loop: even at the
    resonance, the sine trips no interlock and no limit clips it.
    """
    interlocks, model = setting.axis.interlocks, setting.model
    closed_peak = max((model and model.tracking_peak) or 1.0, 1.0)
    swing_um = interlocks.oscillation_um if interlocks.oscillation_swings else np.inf
    swing = Bound(swing_um, f"interlocks.oscillation_um = {swing_um:g}")
    open_peak = model.open_peak if model else 1.0
    return min(
        largest_sine(setting),
        setting.reach.divided(open_peak, "at the resonance the stage's motion without control is", "the amplitude"),
        swing.divided(2 * closed_peak, "the position's swing from peak to peak is", "the amplitude"),
    )


def largest_part_of_drive(setting: Setting) -> Bound:
    """Return the largest step of the drive without control as a fraction 0 … 1 of `limits.drive_v`, with its limit.

    The step's overshoot trips neither the position interlock nor the sensor's. Without a model, the overshoot is taken
    to be 100 %.
    """
    drive_v = setting.axis.limits.drive_v
    overshoot_um = abs(setting.um_per_v) * drive_v * (setting.model.open_overshoot if setting.model else 2.0)
    return min(
        Bound(1.0, f"limits.drive_v = {drive_v:g}"),
        Bound(
            setting.trip_um / overshoot_um,
            f"{setting.trip.reason} (a step from 0 to {drive_v:g} V moves the stage by up to {overshoot_um:.4g} µm)",
        ),
    )


def largest_true(condition: Callable[[float], bool], upper: float) -> float:
    """Return a number from 0 to `upper` for which `condition` holds, at most 10⁻⁹ `upper` below the largest one.

    The search is a bisection: `condition` must be true up to one number, and false above it. Returns `upper` if
    `condition` is true for `upper`, 0 if it is true for no number above 0.
    """
    if condition(upper):
        return upper
    low, high = 0.0, upper
    while high - low > 1e-9 * upper:
        middle = (low + high) / 2
        low, high = (middle, high) if condition(middle) else (low, middle)
    return low
