"""Setpoints that cannot be reached: a constant reference beyond the position interlock of its axis trips the loop."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from rtloop.configuration.axis import AxisOptions, HoldOptions

if TYPE_CHECKING:  # `file` calls this module
    from rtloop.configuration.file import ScheduleOptions

MICROMETRES = ("feedforward", "closed_loop")
"""Modes whose reference is a position."""


def setpoint_fault(value_um: float, position_limit_um: float) -> str | None:
    """Why a constant reference in µm is refused; None for one within the position interlock."""
    if abs(value_um) <= position_limit_um:
        return None
    return f"{value_um:g} µm; within ±{position_limit_um:g} µm (interlocks.position_um) is allowed, beyond it trips"


def setpoint_faults(axes: Sequence[AxisOptions], mode: str, schedule: Sequence[ScheduleOptions]) -> Iterator[str]:
    """A line for each setpoint of axes and schedule that is refused; `mode` is the one that the loop begins in."""
    for axis in axes:
        references = [("reference", mode, axis.reference)]
        current_mode = mode
        for entry in sorted(schedule, key=lambda entry: entry.at_tick):
            current_mode = entry.mode or current_mode
            if entry.reference is not None and entry.axis in (None, axis.name):
                references.append((f"reference from tick {entry.at_tick} on", current_mode, entry.reference))
        for label, current_mode, reference in references:
            if current_mode not in MICROMETRES or not isinstance(reference, HoldOptions):
                continue
            if (fault := setpoint_fault(reference.value, axis.interlocks.position_um)) is not None:
                yield f"axis.{axis.name}.{label}: {fault}"
