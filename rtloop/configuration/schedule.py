"""[[schedule]]: changes of mode and reference at given ticks, and the check of their setpoints.

A constant reference beyond the position interlock of its axis would trip the loop: it is refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal, Self

from pydantic import Field, model_validator

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.reference_options import HoldOptions, ReferenceOptions
from rtloop.foundation.options import Options

ModeName = Literal["off", "raw", "feedforward", "closed_loop"]
MICROMETRES = ("feedforward", "closed_loop")
"""Modes with a position as reference."""


class ScheduleOptions(Options):
    """A change of mode or reference, or a reset, at one tick."""

    at_tick: int = Field(ge=0)
    """Number of the tick in which the change takes effect; the first tick of the loop is 0."""
    axis: str | None = None
    """Name of the axis whose reference changes, all axes by default; allowed with `reference` only."""
    mode: ModeName | None = None
    """Mode of all axes from this tick on."""
    reference: ReferenceOptions | None = None
    """Reference that begins in this tick."""
    reset_trip: bool = False
    """Clear latched trips; the mode stays off until another entry or a client sets one."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Require exactly one of mode, reference and reset_trip; `axis` is optional with a reference, else refused."""
        changes = [self.mode is not None, self.reference is not None, self.reset_trip]
        if sum(changes) != 1:
            raise ValueError(
                f"{sum(changes)} changes in one entry; allowed: exactly one of mode, reference, reset_trip"
            )
        if self.axis is not None and self.reference is None:
            raise ValueError(
                f"axis: {self.axis!r} is set in an entry without a reference; mode and reset_trip act on all axes. "
                "Remove the key axis from this entry"
            )
        return self


def setpoint_fault(value_um: float, position_limit_um: float) -> str | None:
    """Return the fault of a constant reference in µm; None for one within ± `position_limit_um`, ends included."""
    if abs(value_um) <= position_limit_um:
        return None
    return (
        f"{value_um:g} µm; allowed: within ±{position_limit_um:g} µm (interlocks.position_um), where no interlock trips"
    )


def setpoint_faults(axes: Sequence[AxisOptions], mode: str, schedule: Sequence[ScheduleOptions]) -> Iterator[str]:
    """Yield a line for each constant reference in µm of axes and schedule beyond its axis's position interlock.

    The loop begins in `mode`, in which the references of the axes are judged; one of the schedule is judged in the mode
    of its tick.
    """
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
