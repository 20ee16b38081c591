"""Timeline of one run: modes and references one after the other, as a schedule."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from rtloop.configuration.schedule import ModeName

if TYPE_CHECKING:
    from rtloop.foundation.arrays import Real

Reference = Mapping[str, Any]
APPROACH = "approach"
"""Label of the segments that lead from 0 to the middle."""
APPROACH_S, APPROACH_REST_S = 0.2, 0.3
"""Durations of the way from 0 to the middle about which a run moves, and of the rest there."""
DEPOLARISING_CYCLES, DEPOLARISING_HZ = 100, 25.0
"""Number of cycles and their frequency. From 10 V, each cycle is 0.1 V smaller: the
remaining memory is about as small."""


class Segment(NamedTuple):
    """A range of ticks with one mode and one reference; `values` are facts for the analysis."""

    label: str
    mode: str
    start_tick: int
    ticks: int
    values: dict[str, Any]

    @property
    def tick_slice(self) -> slice:
        """The ticks of the segment as a slice."""
        return slice(self.start_tick, self.start_tick + self.ticks)

    def tail_slice(self, ticks: int) -> slice:
        """Return the last `ticks` of the segment as a slice."""
        end = self.start_tick + self.ticks
        return slice(end - ticks, end)


class Middle(NamedTuple):
    """Middle about which a run moves: the command in µm, and the drive in V that holds it after a slow rise from 0."""

    um: float = 0.0
    v: float = 0.0

    def shifted(self, reference: Reference, mode: ModeName) -> Reference:
        """Return a reference about 0, of kind hold, sine or steps, moved to the middle: by `v` in mode raw, else `um`.

        A table is returned unchanged: its samples are in a file.
        """
        offset = self.v if mode == "raw" else self.um
        if not offset or reference["kind"] == "table":
            return reference
        if reference["kind"] == "steps":
            return {**reference, "levels": [level + offset for level in reference["levels"]]}
        key = "value" if reference["kind"] == "hold" else "offset"
        return {**reference, key: reference[key] + offset}


ABOUT_ZERO = Middle()


class Timeline:
    """Segments of one run, in order, and the reference of each."""

    def __init__(self, rate_hz: float, middle: Middle = ABOUT_ZERO) -> None:
        """Begin without segments; `rate_hz` converts their durations in s to ticks.

        References of added segments are about `middle`, to which a slow half cycle leads first.
        """
        self._rate_hz, self.middle = rate_hz, middle
        self.segments: list[Segment] = []
        self.references: list[Reference] = []

    @property
    def ticks(self) -> int:
        """Number of ticks of all segments."""
        return self.segments[-1].start_tick + self.segments[-1].ticks if self.segments else 0

    def add(self, label: str, mode: ModeName, reference: Reference, duration_s: float, **values: float) -> None:
        """Append a segment of `duration_s`, at least one tick; `reference` is about 0, and moved to the middle.

        Before the first segment that is added, segments APPROACH are appended that lead to a middle other than 0.
        `values` are facts for the analysis.
        """
        if any(self.middle) and not any(segment.label == APPROACH for segment in self.segments):
            half = (self.middle.v if mode == "raw" else self.middle.um) / 2
            self._append(APPROACH, mode, sine(half, 0.5 / APPROACH_S, half, -90.0), APPROACH_S)
            self._append(APPROACH, mode, self.middle.shifted(hold(0.0), mode), APPROACH_REST_S)
        self._append(label, mode, self.middle.shifted(reference, mode), duration_s, **values)

    def _append(self, label: str, mode: ModeName, reference: Reference, duration_s: float, **values: float) -> None:
        """Append a segment of at least one tick, with `reference` unchanged."""
        ticks = max(1, round(duration_s * self._rate_hz))
        self.segments.append(Segment(label, mode, self.ticks, ticks, values))
        self.references.append(reference)

    def depolarise(self, amplitude_v: float, middle_v: float = 0.0) -> None:
        """Append DEPOLARISING_CYCLES cycles of a sine of the drive about `middle_v`, which erase the actuator's memory.

        Each cycle is a little smaller than the one before. Half a cycle leads from 0 V to a `middle_v` other than 0,
        and another one back to 0 V at the end.
        """
        half_s, half_v = 0.5 / DEPOLARISING_HZ, middle_v / 2
        if middle_v:
            self._append("depolarise", "raw", sine(half_v, DEPOLARISING_HZ, half_v, -90.0), half_s)
        for remaining in range(DEPOLARISING_CYCLES, 0, -1):
            reference = sine(amplitude_v * remaining / DEPOLARISING_CYCLES, DEPOLARISING_HZ, middle_v)
            self._append("depolarise", "raw", reference, 1 / DEPOLARISING_HZ)
        if middle_v:
            self._append("depolarise", "raw", sine(half_v, DEPOLARISING_HZ, half_v, 90.0), half_s)

    def schedule(self, axis: str) -> list[dict[str, object]]:
        """Return the entries of [[schedule]] for all segments but the first, in the order of time.

        Each segment has {at_tick, axis, reference}, followed by {at_tick, mode} where the mode changes. A mode holds
        for the whole loop, not for `axis` alone.
        """
        entries: list[dict[str, object]] = []
        for previous, segment, reference in zip(self.segments, self.segments[1:], self.references[1:], strict=False):
            tick_entry = {"at_tick": segment.start_tick}
            entries.append({**tick_entry, "axis": axis, "reference": dict(reference)})
            if segment.mode != previous.mode:
                entries.append({**tick_entry, "mode": segment.mode})
        return entries


def hold(value: float) -> Reference:
    """Return a constant reference, {kind: "hold", value}, in V in mode raw, else in µm."""
    return {"kind": "hold", "value": float(value)}


def sine(amplitude: float, frequency_hz: float, offset: float = 0.0, phase_deg: float = 0.0) -> Reference:
    """Return the reference {kind: "sine", amplitude, frequency_hz, offset, phase_deg}, in V in mode raw, else in µm.

    The sine is about `offset`; with a phase of 0, it begins at `offset` and rises.
    """
    return {
        "kind": "sine",
        "amplitude": float(amplitude),
        "frequency_hz": float(frequency_hz),
        "offset": float(offset),
        "phase_deg": float(phase_deg),
    }


@dataclass(frozen=True)
class Run:
    """Plan of one recording: the loop's timeline, and changes of the simulated rig."""

    label: str
    timeline: Timeline
    plant: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Changes to the simulated plant, section by section (`rtloop.hil.options.PlantOptions`)."""
    may_trip: bool = False
    """A trip is a result, not a failure."""
    tables: Mapping[str, Real] = field(default_factory=dict)
    """Samples (n, 1 or 2) by the name of the file from which its references read them."""
