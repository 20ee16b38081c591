"""Parts of the base configuration that an experiment may use, and the largest amplitudes there."""

from __future__ import annotations

import math
from collections.abc import Callable
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
from rtloop.hysteresis.reach import can_hold

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
    sensor_ends_um: tuple[float, float] = (-np.inf, np.inf)
    """Lowest and highest position that the sensor shows within its interlocks."""
    rig_delay_ticks: int = 0
    """Samples of delay of the simulated rig; 0 for any other driver."""

    def timeline(
        self, rest_mode: ModeName | None = None, rest_s: float = REST_S, *, uses_whole_drive: bool = False
    ) -> Timeline:
        """Return a timeline that depolarises an actuator with a memory, then rests at 0 in `rest_mode`.

        None: no rest. It depolarises about 0, or, with `uses_whole_drive`, about the middle of the allowed drive.
        """
        timeline = Timeline(self.rate_hz)
        low_v, high_v = self.drive_range_v
        if not self.is_virgin and uses_whole_drive:
            timeline.depolarise((high_v - low_v) / 2, (high_v + low_v) / 2)
        elif not self.is_virgin:
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

    def _trip_towards(self, direction: float) -> Bound:
        """Largest displacement before the dynamics, µm, towards ±1, that trips no interlock."""
        interlocks, gain = self.axis.interlocks, abs(self.model.static_gain) if self.model else 1.0
        end_um = self.sensor_ends_um[1] if direction > 0 else -self.sensor_ends_um[0]
        ends = f"sensor_min_v = {interlocks.sensor_min_v:g} and sensor_max_v = {interlocks.sensor_max_v:g}"
        sensor_range = f"on this side the sensor's range ends at {end_um:.4g} µm"
        return min(
            Bound(interlocks.position_um / gain, f"interlocks.position_um = {interlocks.position_um:g}"),
            Bound(max(end_um, 0.0) / gain, f"interlocks.{ends} ({sensor_range})"),
        )

    def _largest_drive(self, direction: float) -> tuple[float, str]:
        """Largest slow drive in V, from rest, towards ±1, and the key with its value that limits it."""
        limits = self.axis.limits
        largest_v, reason = (limits.drive_v, f"limits.drive_v = {limits.drive_v:g}")
        if direction < 0:
            largest_v = -limits.lowest_v
            reason = reason if limits.drive_min_v is None else f"limits.drive_min_v = {limits.lowest_v:g}"
        trip = self._trip_towards(direction * math.copysign(1.0, self.um_per_v))
        drives_v = np.linspace(0.0, largest_v, 1001)
        displacement_um = np.abs(loading_curve(self.axis.feedforward.actuator(), drives_v))
        tripping = np.flatnonzero(displacement_um > trip.magnitude)
        return (float(drives_v[max(tripping[0] - 1, 1)]), trip.reason) if tripping.size else (largest_v, reason)

    @property
    def drive_range_v(self) -> tuple[float, float]:
        """Lowest and highest slow drive in V: within its limits, and below the interlocks of position and sensor."""
        return -self._largest_drive(-1.0)[0], self._largest_drive(1.0)[0]

    @property
    def reach_v(self) -> float:
        """Largest slow drive in V to both sides: within its limits, and below the interlocks of position and sensor."""
        low_v, high_v = self.drive_range_v
        return min(-low_v, high_v)

    @property
    def reach(self) -> Bound:
        """Largest slow command in µm to both sides, such as a sine about 0 has, from rest.

        It is within the limits of command and drive, and trips neither the position interlock nor the sensor's.
        """
        limits = self.axis.limits
        direction = -1.0 if -self.drive_range_v[0] < self.drive_range_v[1] else 1.0
        held_um = abs(float(loading_curve(self.axis.feedforward.actuator(), self.reach_v)))
        return min(
            Bound(limits.command_um, f"limits.command_um = {limits.command_um:g}"),
            Bound(held_um, self._largest_drive(direction)[1]),
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
        """Largest step of the reference up from 0, µm, and back."""
        return self._largest_step_towards(1.0)

    @property
    def largest_step_down(self) -> Bound:
        """Largest step of the reference down from 0, µm, and back."""
        return self._largest_step_towards(-1.0)

    def _largest_step_towards(self, direction: float) -> Bound:
        """Largest step of the reference from 0 towards ±1, and back, in µm.

        The longer side of the drive comes first; steps towards the other side find the memory that its steps leave.
        """
        peak = max((self.model and self.model.step_peak) or UNKNOWN_PEAK, MIN_PEAK)
        modelled_reversal = None if self.model is None else self.model.step_reversal
        reversal = UNKNOWN_PEAK - 1 if modelled_reversal is None else max(modelled_reversal, MIN_PEAK - 1)
        sign = direction * math.copysign(1.0, self.um_per_v)
        before = np.zeros(1)
        if sign * sum(self.drive_range_v) < 0 or (sum(self.drive_range_v) == 0 and direction < 0):
            before = -self._largest_step_towards(-direction).magnitude * np.array([peak, -reversal])
        most = min(
            Bound(self.axis.limits.command_um, f"limits.command_um = {self.axis.limits.command_um:g}"),
            self._trip_towards(direction),
        ).divided(peak, "the command of a step is up to")

        def is_held(height: float) -> bool:
            """Whether the drive holds the commands of a step of `height` and of the step back, after the others."""
            commands_um = direction * np.concatenate([before, height * np.array([peak, -reversal])])
            return can_hold(self.axis.feedforward.actuator(), commands_um, *self.drive_range_v)

        held_um = largest_true(is_held, most.magnitude)
        peak_um = direction * np.append(before, held_um * (1 + 1e-6) * peak)
        is_peak_held = can_hold(self.axis.feedforward.actuator(), peak_um, *self.drive_range_v)
        if is_peak_held:
            key, effect = self._largest_drive(-sign)[1], f"step back goes {reversal:.3g} times as far beyond 0"
        else:
            key, effect = self._largest_drive(sign)[1], f"step is up to {peak:.3g} times as large"
        return min(most, Bound(held_um, f"{key} (the command of a {effect})"))

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


def largest_true(condition: Callable[[float], bool], most: float) -> float:
    """Return the largest number from 0 to `most` up to which `condition` holds, to a part in 10⁹, by bisection."""
    low, high = 0.0, most
    if condition(most):
        return most
    while high - low > 1e-9 * most:
        middle = (low + high) / 2
        low, high = (middle, high) if condition(middle) else (low, middle)
    return low
