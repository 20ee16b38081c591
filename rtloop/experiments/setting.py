"""What an experiment may know of the configuration that it is derived from, and how far it may go there."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from rtloop.configuration.axis import AxisOptions
from rtloop.design.synthesis.specification import SpecificationOptions
from rtloop.experiments.linear_model import LinearModel, linear_model
from rtloop.experiments.timeline import Timeline
from rtloop.hysteresis.plays import loading_curve

UNKNOWN_PEAK, MIN_PEAK = 1.4, 1.1
"""Of the command per step of the reference: where no model tells, and what the hysteresis takes at least."""
FEEDFORWARD_PEAK = 1.02
"""The dead band that the inverse takes off may come on top."""


@dataclass(frozen=True)
class Setting:
    """The axis, the loop's rate, and what is asked of the loop."""

    rate_hz: float
    axis: AxisOptions
    is_virgin: bool
    """The actuator begins without memory, as a rig does that exists only while it is called."""
    specification: SpecificationOptions = field(default_factory=SpecificationOptions)

    def timeline(self) -> Timeline:
        """One to be filled; an actuator that may have a memory is depolarised first."""
        timeline = Timeline(self.rate_hz)
        if not self.is_virgin:
            timeline.depolarise(self.reach_v)
        return timeline

    @cached_property
    def model(self) -> LinearModel | None:
        """What [axis.model] promises."""
        return linear_model(self.axis, self.rate_hz)

    @property
    def trip_um(self) -> float:
        """The position interlock as a displacement before the dynamics."""
        return self.axis.interlocks.position_um / (abs(self.model.static_gain) if self.model else 1.0)

    @property
    def reach_v(self) -> float:
        """How far a slow drive may go to both sides: by its limits, and where the position trips."""
        largest_v = min(self.axis.limits.drive_v, -self.axis.limits.lowest_v)
        drives_v = np.linspace(0.0, largest_v, 1001)
        displacement_um = np.abs(loading_curve(self.axis.feedforward.actuator(), drives_v))
        tripping = np.flatnonzero(displacement_um > self.trip_um)
        return float(drives_v[max(tripping[0] - 1, 1)]) if tripping.size else largest_v

    @property
    def reach_um(self) -> float:
        """How far the command may go to both sides: by its own limit, the drive's, and where the position trips."""
        return min(self.axis.limits.command_um, abs(self.um_per_v) * self.reach_v, self.trip_um)

    @property
    def um_per_v(self) -> float:
        """Static gain of the axis's hysteresis model over its whole range."""
        largest_v = self.axis.limits.drive_v
        return float(loading_curve(self.axis.feedforward.actuator(), largest_v) / largest_v)

    @property
    def largest_command_um(self) -> float:
        """Of a slow command without feedback."""
        return self.reach_um / FEEDFORWARD_PEAK

    @property
    def largest_step_um(self) -> float:
        """Of a step of the reference."""
        return self.reach_um / max((self.model and self.model.step_peak) or UNKNOWN_PEAK, MIN_PEAK)

    @property
    def largest_sine_um(self) -> float:
        """Of a sine of the reference."""
        return self.reach_um / max((self.model and self.model.sine_peak) or UNKNOWN_PEAK, MIN_PEAK)

    @property
    def largest_swept_um(self) -> float:
        """Of a sine at any frequency, with and without control: nothing trips or is clipped at the resonance."""
        interlocks = self.axis.interlocks
        closed_peak = max((self.model and self.model.tracking_peak) or 1.0, 1.0)
        swing_um = interlocks.oscillation_um / (2 * closed_peak) if interlocks.oscillation_swings else np.inf
        open_peak = self.model.open_peak if self.model else 1.0
        return min(self.largest_sine_um, self.reach_um / open_peak, swing_um)

    @property
    def largest_part_of_drive(self) -> float:
        """Of the drive's limit, all at once and without control."""
        overshoot_um = (
            abs(self.um_per_v) * self.axis.limits.drive_v * (self.model.open_overshoot if self.model else 2.0)
        )
        return min(1.0, self.trip_um / overshoot_um)
