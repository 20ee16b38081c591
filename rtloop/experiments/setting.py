"""Parts of the base configuration that an experiment may use, and the slow drives and commands that it allows."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.schedule import ModeName
from rtloop.configuration.simulated import middle_um, one_sided_range
from rtloop.design.synthesis.specification import SpecificationOptions
from rtloop.experiments.linear_model import LinearModel, linear_model
from rtloop.experiments.timeline import ABOUT_ZERO, Middle, Timeline, hold
from rtloop.hysteresis.plays import loading_curve, model_output

REST_S = 0.1


class Bound(NamedTuple):
    """Largest magnitude of an option in its unit, µm or 1, and the key of the axis, with its value, that limits it."""

    magnitude: float
    reason: str

    def divided(self, factor: float, effect: str, signal: str) -> Bound:
        """Return the bound of `signal` where the limited signal is `factor` times as large: the magnitude / `factor`.

        The reason gets an explanation that begins with `effect`: "(`effect` 1.4 times as large as `signal`)".
        """
        return Bound(self.magnitude / factor, f"{self.reason} ({effect} {factor:.3g} times as large as {signal})")


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
        """Return a new timeline that begins with depolarising, unless `is_virgin`, and a rest at `middle`.

        The rest lasts `rest_s` in `rest_mode`; None: no rest. The actuator is depolarised about 0 V; if the drive has
        one sign or `uses_whole_drive` is True, about the middle of the drive's range. With `uses_whole_drive`, rests
        and motions are about 0 instead of `middle`.
        """
        timeline = Timeline(self.rate_hz, ABOUT_ZERO if uses_whole_drive else self.middle)
        low_v, high_v = self.drive_range_v
        if not self.is_virgin and (uses_whole_drive or self.is_one_sided):
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
        """Largest |input| of the dynamics, µm, that trips neither the position interlock nor the sensor's, and its key.

        The motion is about 0; the input of the dynamics is the displacement of the actuator.
        """
        return self._trip_bound(self.sensor_um, "for a motion about 0")

    @property
    def trip_um(self) -> float:
        """Largest |input| of the dynamics, µm, about 0, that trips neither the position interlock nor the sensor's."""
        return self.trip.magnitude

    def trip_towards(self, direction: float) -> Bound:
        """Return the largest |input| of the dynamics in µm, for positions above 0 (`direction` 1) or below 0 (−1).

        It trips neither the position interlock nor the sensor's: it is the smaller of the two ranges of the position,
        divided by the |static gain| of the dynamics. The bound names the key that sets it.
        """
        return self._trip_bound(self.sensor_ends_um[1] if direction > 0 else -self.sensor_ends_um[0], "on this side")

    def _trip_bound(self, sensor_end_um: float, place: str) -> Bound:
        """Return the largest |input| of the dynamics in µm: the smaller bound of position interlock and sensor.

        The sensor's range ends at the position `sensor_end_um`; `place` is the beginning of the reason's explanation,
        such as "on this side".
        """
        interlocks, gain = self.axis.interlocks, abs(self.model.static_gain) if self.model else 1.0
        ends = f"sensor_min_v = {interlocks.sensor_min_v:g} and sensor_max_v = {interlocks.sensor_max_v:g}"
        sensor_range = f"{place} the sensor's range ends at {sensor_end_um:.4g} µm"
        return min(
            Bound(interlocks.position_um / gain, f"interlocks.position_um = {interlocks.position_um:g}"),
            Bound(max(sensor_end_um, 0.0) / gain, f"interlocks.{ends} ({sensor_range})"),
        )

    def largest_drive(self, direction: float) -> tuple[float, str]:
        """Return the largest magnitude ≥ 0, in V, of a slow drive from 0 V, and the key that limits it.

        `direction` is 1 for drives above 0 V, −1 for drives below 0 V. The key, with its value, is the drive's limit,
        such as "limits.drive_v = 10", or the interlock that trips at a smaller drive on the initial loading curve.
        """
        limits = self.axis.limits
        largest_v, reason = (limits.drive_v, f"limits.drive_v = {limits.drive_v:g}")
        if direction < 0:
            largest_v = -limits.lowest_v
            reason = reason if limits.drive_min_v is None else f"limits.drive_min_v = {limits.lowest_v:g}"
        trip = self.trip_towards(direction * math.copysign(1.0, self.um_per_v))
        drives_v = np.linspace(0.0, largest_v, 1001)
        displacement_um = np.abs(loading_curve(self.axis.feedforward.actuator(), drives_v))
        tripping = np.flatnonzero(displacement_um > trip.magnitude)
        return (float(drives_v[max(tripping[0] - 1, 1)]), trip.reason) if tripping.size else (largest_v, reason)

    @property
    def drive_range_v(self) -> tuple[float, float]:
        """Lowest (≤ 0) and highest (≥ 0) slow drive in V, within its limits, that trips neither the position interlock
        nor the sensor's.
        """
        return -self.largest_drive(-1.0)[0], self.largest_drive(1.0)[0]

    @property
    def is_one_sided(self) -> bool:
        """Whether the drive has one sign alone: its lowest value is 0 V."""
        return self.axis.limits.lowest_v == 0.0

    @cached_property
    def middle(self) -> Middle:
        """Middle about which experiments move: 0 or, for a drive of one sign, the middle of the reachable range."""
        if not self.is_one_sided:
            return ABOUT_ZERO
        middle = middle_um(self.axis, self.sensor_ends_um)
        return Middle(middle, float(model_output(self.axis.feedforward.actuator().inverse(), [middle])[0]))

    @property
    def reach_v(self) -> float:
        """Largest slow drive in V to both sides of 0 V.

        It is within the drive's limits, and trips neither the position interlock nor the sensor's.
        """
        low_v, high_v = self.drive_range_v
        return min(-low_v, high_v)

    @property
    def reach(self) -> Bound:
        """Largest slow command in µm to both sides of the middle, such as the amplitude of a sine, with its limit.

        The motion begins at rest. The command is within the limits of command and drive, and trips neither the position
        interlock nor the sensor's.
        """
        limits = self.axis.limits
        if self.is_one_sided:
            low_um, high_um = one_sided_range(self.axis, self.sensor_ends_um)
            commands_text = f"only commands of {low_um:.4g} … {high_um:.4g} µm can follow each other in any order"
            reason = f"limits.drive_min_v = 0 ({commands_text})"
            return Bound(min(high_um - self.middle.um, self.middle.um - low_um), reason)
        direction = -1.0 if -self.drive_range_v[0] < self.drive_range_v[1] else 1.0
        held_um = abs(float(loading_curve(self.axis.feedforward.actuator(), self.reach_v)))
        return min(
            Bound(limits.command_um, f"limits.command_um = {limits.command_um:g}"),
            Bound(held_um, self.largest_drive(direction)[1]),
            self.trip,
        )

    @property
    def reach_um(self) -> float:
        """Largest slow command in µm to both sides of the middle: the magnitude of `reach`."""
        return self.reach.magnitude

    @property
    def um_per_v(self) -> float:
        """Mean gain of the axis's hysteresis model, µm/V, on the initial loading curve from 0 V to `limits.drive_v`."""
        largest_v = self.axis.limits.drive_v
        return float(loading_curve(self.axis.feedforward.actuator(), largest_v) / largest_v)
