"""What an experiment is, and what it asks of the loop: modes and references one after the other, as a schedule."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hil.options import Options
from rtloop.config import Configuration, ModeName
from rtloop.design.plays import loading_curve
from rtloop.errors import ConfigError
from rtloop.identifying import actuator_model
from rtloop.law.options import AxisOptions

if TYPE_CHECKING:
    from rtloop.experiments.taken import Taken
    from rtloop.experiments.verdict import Analysis

Reference = Mapping[str, Any]
DEPOLARISING_CYCLES, DEPOLARISING_HZ = 100, 25.0
"""Of 10 V each cycle is 0.1 V smaller, so that the rest differs from a virgin one by about as little."""
CLOSED_PEAK = 1.4
"""Of the command in closed loop, per step of the reference: the paper's, at 10 kHz; others are checked afterwards."""


class Segment(NamedTuple):
    """A stretch of ticks with one mode and one reference; `values` are what the analysis needs to know of it."""

    label: str
    mode: str
    start_tick: int
    ticks: int
    values: dict[str, Any]


class Timeline:
    """Segments of one run, in order."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self.segments: list[Segment] = []
        self.references: list[Reference] = []

    @property
    def ticks(self) -> int:
        """Ticks so far."""
        return self.segments[-1].start_tick + self.segments[-1].ticks if self.segments else 0

    def add(self, label: str, mode: ModeName, reference: Reference, duration_s: float, **values: Any) -> None:
        """Append a segment of at least one tick."""
        ticks = max(1, round(duration_s * self._rate_hz))
        self.segments.append(Segment(label, mode, self.ticks, ticks, values))
        self.references.append(reference)

    def depolarise(self, amplitude_v: float) -> None:
        """Wipe out the actuator's memory: whole cycles of a sine, each a little smaller than the one before."""
        for left in range(DEPOLARISING_CYCLES, 0, -1):
            wave = sine(amplitude_v * left / DEPOLARISING_CYCLES, DEPOLARISING_HZ)
            self.add("depolarise", "raw", wave, 1 / DEPOLARISING_HZ)

    def schedule(self, axis: str) -> list[dict[str, Any]]:
        """Entries of [[schedule]] for all but the first segment."""
        entries: list[dict[str, Any]] = []
        for before, segment, reference in zip(self.segments, self.segments[1:], self.references[1:], strict=False):
            at = {"at_tick": segment.start_tick}
            entries.append({**at, "axis": axis, "reference": dict(reference)})
            if segment.mode != before.mode:
                entries.append({**at, "mode": segment.mode})
        return entries


def hold(value: float) -> Reference:
    """A constant, in V in mode raw, else in µm."""
    return {"kind": "hold", "value": float(value)}


def sine(amplitude: float, frequency_hz: float, offset: float = 0.0, phase_deg: float = 0.0) -> Reference:
    """A sine about `offset`."""
    return {
        "kind": "sine",
        "amplitude": float(amplitude),
        "frequency_hz": float(frequency_hz),
        "offset": float(offset),
        "phase_deg": float(phase_deg),
    }


@dataclass(frozen=True)
class Setting:
    """What an experiment may know of the configuration that it is derived from."""

    rate_hz: float
    axis: AxisOptions
    virgin: bool
    """The actuator begins without memory, as a rig does that exists only while it is called."""

    def timeline(self) -> Timeline:
        """One to be filled; an actuator that may have a memory is depolarised first."""
        timeline = Timeline(self.rate_hz)
        if not self.virgin:
            timeline.depolarise(self.reach_v)
        return timeline

    @property
    def reach_v(self) -> float:
        """How far the drive may go to both sides."""
        return min(self.axis.limits.drive_v, -self.axis.limits.lowest_v)

    @property
    def reach_um(self) -> float:
        """How far the command may go to both sides: by its own limit, the drive's, and where the position trips."""
        static_gain = self.axis.model.transfer().dc_gain if self.axis.model else 1.0
        trips_um = self.axis.interlocks.position_um / max(abs(static_gain), 1e-9)
        return min(self.axis.limits.command_um, abs(self.um_per_v) * self.reach_v, trips_um)

    @property
    def um_per_v(self) -> float:
        """Static gain of the axis's hysteresis model over its whole range."""
        largest_v = self.axis.limits.drive_v
        return float(loading_curve(actuator_model(self.axis.feedforward), largest_v) / largest_v)


@dataclass(frozen=True)
class Run:
    """One recording: what the loop does, and what is another rig than the configuration's."""

    label: str
    timeline: Timeline
    plant: Mapping[str, Any] = field(default_factory=dict)
    """Changes to the simulated plant, section by section (`hil.options.PlantOptions`)."""
    may_trip: bool = False
    """A trip is a result and not a failure."""


@dataclass(frozen=True)
class Experiment:
    """A procedure, and the analysis of its recordings."""

    name: str
    title: str
    figure: str
    about: str
    options: type[Options]
    runs: Callable[[Any, Setting], list[Run]]
    analyse: Callable[[Sequence[Taken], Any], Analysis]
    draw: Callable[[Any, Mapping[str, Any], Any], None]
    commanded: Mapping[str, float] = field(default_factory=dict)
    """Options in µm, and how many times as much the command may have to be at its peak."""
    both_ways: bool = True
    """It drives to both sides of 0 V."""
    needs_controller: bool = True
    needs_rig: bool = False
    size: tuple[float, float] = (11.0, 5.0)

    def unsuitable(self, configuration: Configuration, axis: AxisOptions, rig: bool) -> str | None:
        """Why this experiment cannot be done with a configuration; None where it can."""
        if self.needs_controller and axis.controller is None:
            return f"axis.{axis.name}.controller: missing; this experiment closes the loop"
        if self.both_ways and axis.limits.lowest_v == 0.0:
            return f"axis.{axis.name}.limits.drive_min_v: 0 V; this experiment drives to both sides"
        if self.needs_rig and not rig:
            kind = configuration.driver_kind
            return f"driver.kind {kind!r} has no option for it: only the simulated rig called inline can be changed"
        return None

    def fitted(self, options: Options, setting: Setting) -> Options:
        """The options, with what nobody set made as small as the axis's limits demand.

        Raises ConfigError for what somebody set and the limits forbid.
        """
        smaller: dict[str, Any] = {}
        for key, peak in self.commanded.items():
            value = getattr(options, key)
            asked_um, most_um = float(np.max(np.abs(value))), setting.reach_um / peak
            if asked_um <= most_um:
                continue
            if key in options.model_fields_set:
                allowed = f"axis {setting.axis.name!r} allows {most_um:.4g} µm here, by its limits and interlocks"
                raise ConfigError("parameters of the experiments", [f"{self.name}.{key}: {asked_um:g} µm; {allowed}"])
            step_um = 10.0 ** (math.floor(math.log10(most_um)) - 1)
            scale = math.floor(most_um / step_um) * step_um / asked_um
            smaller[key] = tuple(scale * one for one in value) if isinstance(value, tuple) else scale * value
        return options.model_copy(update=smaller)
