"""What an experiment is, and what it asks of the loop: modes and references one after the other, as a schedule."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.file import Configuration, ModeName
from rtloop.errors import ConfigError
from rtloop.foundation.options import Options

if TYPE_CHECKING:
    from rtloop.experiments.recorded_run import RecordedRun
    from rtloop.experiments.setting import Setting
    from rtloop.experiments.verdict import Analysis

Reference = Mapping[str, Any]
DEPOLARISING_CYCLES, DEPOLARISING_HZ = 100, 25.0
"""Of 10 V each cycle is 0.1 V smaller, so that the rest differs from a virgin one by about as little."""


class UnsuitableLoop(Exception):
    """Why an experiment cannot be done with this loop, whatever its parameters."""


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
        for remaining in range(DEPOLARISING_CYCLES, 0, -1):
            reference = sine(amplitude_v * remaining / DEPOLARISING_CYCLES, DEPOLARISING_HZ)
            self.add("depolarise", "raw", reference, 1 / DEPOLARISING_HZ)

    def schedule(self, axis: str) -> list[dict[str, Any]]:
        """Entries of [[schedule]] for all but the first segment."""
        entries: list[dict[str, Any]] = []
        for previous, segment, reference in zip(self.segments, self.segments[1:], self.references[1:], strict=False):
            tick_entry = {"at_tick": segment.start_tick}
            entries.append({**tick_entry, "axis": axis, "reference": dict(reference)})
            if segment.mode != previous.mode:
                entries.append({**tick_entry, "mode": segment.mode})
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
class Run:
    """One recording: what the loop does, and what is another rig than the configuration's."""

    label: str
    timeline: Timeline
    plant: Mapping[str, Any] = field(default_factory=dict)
    """Changes to the simulated plant, section by section (`rtloop.hil.options.PlantOptions`)."""
    may_trip: bool = False
    """A trip is a result and not a failure."""
    tables: Mapping[str, Any] = field(default_factory=dict)
    """Samples (n, 1 or 2) by the name of the file that its references are to read them from."""


@dataclass(frozen=True)
class Experiment:
    """A procedure, and the analysis of its recordings."""

    name: str
    title: str
    description: str
    options: type[Options]
    runs: Callable[[Any, Setting], list[Run]]
    analyse: Callable[[Sequence[RecordedRun], Any], Analysis]
    draw: Callable[[Any, Mapping[str, Any], Any], None]
    next_run: Callable[[Sequence[RecordedRun], Any, Setting], Run | None] | None = None
    """A further run, made of what was recorded so far; None when there is nothing more to do."""
    defaults: Mapping[str, Callable[[Setting], Any]] = field(default_factory=dict)
    """Of the options that are None where nobody sets them."""
    limits: Mapping[str, Callable[[Setting], float]] = field(default_factory=dict)
    """How far an option may go to either side."""
    is_bipolar: bool = True
    """It drives to both sides of 0 V."""
    needs_controller: bool = True
    needs_rig: bool = False
    size: tuple[float, float] = (11.0, 5.0)

    def unsuitable_reason(self, configuration: Configuration, axis: AxisOptions, is_rig: bool) -> str | None:
        """Why this experiment cannot be done with a configuration; None where it can."""
        axis_index = [axis_options.name for axis_options in configuration.axes].index(axis.name)
        if self.needs_controller and configuration.axes[configuration.owners[axis_index]].controller is None:
            return f"axis.{axis.name}.controller: missing; this experiment closes the loop"
        if self.is_bipolar and axis.limits.lowest_v == 0.0:
            return f"axis.{axis.name}.limits.drive_min_v: 0 V; this experiment drives to both sides"
        if self.needs_rig and not is_rig:
            kind = configuration.driver_kind
            return f"driver.kind {kind!r} has no option for it: only the simulated rig called inline can be changed"
        return None

    def fit_options(self, options: Options, setting: Setting) -> Options:
        """The options, with what nobody set made to suit the axis, and as small as its limits demand.

        Raises ConfigError for what somebody set and the limits forbid.
        """
        changes = {key: default(setting) for key, default in self.defaults.items() if getattr(options, key) is None}
        faults = []
        for key, limit_of_setting in self.limits.items():
            value = changes.get(key, getattr(options, key))
            magnitude, limit = float(np.max(np.abs(value))), limit_of_setting(setting)
            if magnitude <= limit:
                continue
            if key in options.model_fields_set:
                unit = " µm" if key.endswith("_um") else ""
                allowed = f"axis {setting.axis.name!r} allows {limit:.4g}{unit} here, by its limits and interlocks"
                faults.append(f"{self.name}.{key}: {magnitude:g}{unit}; {allowed}")
                continue
            step = 10.0 ** (math.floor(math.log10(limit)) - 1)
            scale = math.floor(limit / step) * step / magnitude
            changes[key] = tuple(scale * number for number in value) if isinstance(value, tuple) else scale * value
        if faults:
            raise ConfigError("parameters of the experiments", faults)
        return options.model_copy(update=changes)
