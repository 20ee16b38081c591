"""Parts of the base configuration that an experiment may use, and the largest amplitudes there."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.schedule import ModeName
from rtloop.design.synthesis.specification import SpecificationOptions
from rtloop.experiments.linear_model import LinearModel, linear_model
from rtloop.experiments.timeline import Timeline, hold
from rtloop.hysteresis.plays import loading_curve

REST_S = 0.1
UNKNOWN_PEAK, MIN_PEAK = 1.4, 1.1
"""Command per step of the reference without a model, and the least value used, as the hysteresis adds to it."""
FEEDFORWARD_PEAK = 1.02
"""Factor for the dead band, which the inverse may add to the command."""


class Bound(NamedTuple):
    """Largest magnitude of an option in its unit, µm or 1, and the key of the axis, with its value, that limits it."""

    magnitude: float
    reason: str

    def divided(self, factor: float, effect: str) -> Bound:
        """Return the bound of a signal if the limited signal is `factor` times as large: the magnitude over `factor`.

        The reason gets an explanation that begins with `effect`, such as "(`effect` 1.4 times as large)".
        """
        return Bound(self.magnitude / factor, f"{self.reason} ({effect} {factor:.3g} times as large)")


@dataclass(frozen=True)
class Setting:
    """Facts about the configuration that an experiment may use: the axis, the loop's rate, and the specification."""

    rate_hz: float
    axis: AxisOptions
    is_virgin: bool
    """Whether the actuator begins without memory, as a rig that exists only for the run."""
    specification: SpecificationOptions = field(default_factory=SpecificationOptions)
    sensor_um: float = np.inf
    """Largest |position| of a motion about 0 that the sensor shows within its interlocks."""
    rig_delay_ticks: int = 0
    """Samples of delay of the simulated rig; 0 for any other driver."""

    def timeline(self, rest_mode: ModeName | None = None, rest_s: float = REST_S) -> Timeline:
        """Return a timeline that depolarises an actuator with a memory, then rests at 0 in `rest_mode`.

        None: no rest.
        """
        timeline = Timeline(self.rate_hz)
        if not self.is_virgin:
            timeline.depolarise(self.reach_v)
        if rest_mode is not None:
            timeline.add("rest", rest_mode, hold(0.0), rest_s)
        return timeline

    @cached_property
    def model(self) -> LinearModel | None:
        """Linear model of [axis.model] and [axis.controller]; None without [axis.model]."""
        return linear_model(self.axis, self.rate_hz, self.rig_delay_ticks)

    @property
    def trip(self) -> Bound:
        """Largest displacement before the dynamics, µm, that trips neither the position interlock nor the sensor's."""
        interlocks, gain = self.axis.interlocks, abs(self.model.static_gain) if self.model else 1.0
        ends = f"sensor_min_v = {interlocks.sensor_min_v:g} and sensor_max_v = {interlocks.sensor_max_v:g}"
        sensor_range = f"about 0 the sensor's range ends at {self.sensor_um:.4g} µm"
        return min(
            Bound(interlocks.position_um / gain, f"interlocks.position_um = {interlocks.position_um:g}"),
            Bound(self.sensor_um / gain, f"interlocks.{ends} ({sensor_range})"),
        )

    @property
    def trip_um(self) -> float:
        """Largest displacement before the dynamics, µm, that trips neither the position interlock nor the sensor's."""
        return self.trip.magnitude

    @property
    def reach_v(self) -> float:
        """Largest slow drive in V to both sides: within its limits, and below the interlocks of position and sensor."""
        largest_v = min(self.axis.limits.drive_v, -self.axis.limits.lowest_v)
        drives_v = np.linspace(0.0, largest_v, 1001)
        displacement_um = np.abs(loading_curve(self.axis.feedforward.actuator(), drives_v))
        tripping = np.flatnonzero(displacement_um > self.trip_um)
        return float(drives_v[max(tripping[0] - 1, 1)]) if tripping.size else largest_v

    @property
    def reach(self) -> Bound:
        """Largest slow command in µm to both sides.

        It is within the limits of command and drive, and trips neither the position interlock nor the sensor's.
        """
        limits = self.axis.limits
        drive = f"limits.drive_v = {limits.drive_v:g}"
        if -limits.lowest_v < limits.drive_v:
            drive = f"limits.drive_min_v = {limits.lowest_v:g}"
        if self.reach_v < min(limits.drive_v, -limits.lowest_v):
            drive = self.trip.reason
        return min(
            Bound(limits.command_um, f"limits.command_um = {limits.command_um:g}"),
            Bound(abs(self.um_per_v) * self.reach_v, drive),
            self.trip,
        )

    @property
    def reach_um(self) -> float:
        """Largest slow command in µm to both sides."""
        return self.reach.magnitude

    @property
    def um_per_v(self) -> float:
        """Static gain in µm/V of the axis's hysteresis model over its whole range."""
        largest_v = self.axis.limits.drive_v
        return float(loading_curve(self.axis.feedforward.actuator(), largest_v) / largest_v)

    @property
    def largest_command(self) -> Bound:
        """Largest slow command without feedback, µm."""
        return self.reach.divided(FEEDFORWARD_PEAK, "with a dead band the command is up to")

    @property
    def largest_step(self) -> Bound:
        """Largest step of the reference, µm."""
        peak = max((self.model and self.model.step_peak) or UNKNOWN_PEAK, MIN_PEAK)
        return self.reach.divided(peak, "the command of a step is up to")

    @property
    def largest_sine(self) -> Bound:
        """Largest amplitude of a sine of the reference, µm."""
        peak = max((self.model and self.model.sine_peak) or UNKNOWN_PEAK, MIN_PEAK)
        return self.reach.divided(peak, "the command of a sine is up to")

    @property
    def largest_swept(self) -> Bound:
        """Largest amplitude of a sine at any frequency, µm, with and without control.

        It neither trips nor is clipped at the resonance.
        """
        interlocks = self.axis.interlocks
        closed_peak = max((self.model and self.model.tracking_peak) or 1.0, 1.0)
        swing_um = interlocks.oscillation_um if interlocks.oscillation_swings else np.inf
        swing = Bound(swing_um, f"interlocks.oscillation_um = {swing_um:g}")
        open_peak = self.model.open_peak if self.model else 1.0
        return min(
            self.largest_sine,
            self.reach.divided(open_peak, "at the resonance the stage's motion without control is"),
            swing.divided(2 * closed_peak, "the position's swing from peak to peak is"),
        )

    @property
    def largest_part_of_drive(self) -> Bound:
        """Largest step of the drive without control, as a fraction 0 … 1 of the drive's limit."""
        overshoot_um = (
            abs(self.um_per_v) * self.axis.limits.drive_v * (self.model.open_overshoot if self.model else 2.0)
        )
        return min(
            Bound(1.0, f"limits.drive_v = {self.axis.limits.drive_v:g}"),
            Bound(
                self.trip_um / overshoot_um,
                f"{self.trip.reason} (a step of the whole drive moves the stage by {overshoot_um:.4g} µm)",
            ),
        )
