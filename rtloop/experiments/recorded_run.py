"""A recorded run of an experiment: its signals, segment by segment, from the recording alone."""

from __future__ import annotations

import tomllib
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.configuration.axis import AxisOptions
from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.identification.recorded_response import recorded_driver_delay_ticks
from rtloop.design.synthesis.specification import SpecificationOptions
from rtloop.design.verification.judgement import required_limits
from rtloop.experiments.derive import read_metadata
from rtloop.experiments.linear_model import LinearModel, linear_model
from rtloop.experiments.timeline import APPROACH, Segment
from rtloop.experiments.verdict import Row
from rtloop.foundation.arrays import Real
from rtloop.hysteresis.play_model import PlayModel
from rtloop.recording.errors import RecordingError
from rtloop.recording.load import Recording
from rtloop.signals import Flag, Trip

CENTRED = ("reference_um", "position_um", "command_um")
"""Signals that are read relative to the middle of a run's motion."""


class RecordedRun:
    """Signals and description of one run of an experiment.

    Raises RecordingError for a recording whose configuration does not describe such a run.
    """

    def __init__(self, recording: Recording) -> None:
        """Read the run's description from the recorded configuration.

        Raises RecordingError if there is no description, or a damaged one.
        """
        metadata = read_metadata(recording.configuration)
        if metadata is None:
            raise RecordingError(
                f"{recording.paths[0]}: not a recording of an experiment; `rtloop info` shows its content"
            )
        self.recording = recording
        try:
            self._read(metadata)
        except (LookupError, TypeError, ValueError) as error:
            raise RecordingError(
                f"{recording.paths[0]}: the recorded description of the experiment is damaged, or rtloop of another "
                f"version wrote it ({error!r})"
            ) from None

    def _read(self, metadata: dict[str, Any]) -> None:
        """Set this run's attributes from its description, the table that `read_metadata` returns.

        Raises LookupError for a missing key, TypeError or ValueError for unsuitable segments or an invalid
        specification; values of other keys are not checked.
        """
        self.experiment: str = metadata["name"]
        self.label: str = metadata["run"]
        self.run_count: int = metadata["runs"]
        self.axis: str = metadata["axis"]
        self.parameters: dict[str, Any] = metadata["parameters"]
        self.planned_ticks: int = metadata["ticks"]
        self.segments = [Segment(*values) for values in metadata["segments"]]
        self.specification = SpecificationOptions.model_validate(metadata.get("asked", {}))
        self.is_comparison: bool = metadata.get("beside", False)
        self.reductions: list[str] = metadata.get("reduced", [])
        self.middle_um: float = metadata.get("middle_um", 0.0)
        self._may_trip: bool = metadata["may_trip"]

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files of the recording, in the order in which the run wrote them."""
        return self.recording.paths

    @property
    def rate_hz(self) -> float:
        """Ticks per second of the recorded loop."""
        return float(self.recording.header["rate_hz"])

    @cached_property
    def configuration(self) -> dict[str, Any]:
        """The recorded configuration as nested dictionaries of its TOML tables; defaults are not filled in."""
        return tomllib.loads(self.recording.configuration)

    @cached_property
    def axis_options(self) -> AxisOptions:
        """Options of the run's axis, from the recorded configuration, with defaults.

        Raises pydantic's ValidationError, a ValueError, if they are not valid.
        """
        return AxisOptions.model_validate(
            next(axis for axis in self.configuration["axis"] if axis["name"] == self.axis)
        )

    @property
    def actuator_model(self) -> PlayModel:
        """Hysteresis model from drive (V) to displacement (µm) of [axis.feedforward], dead band included."""
        return self.axis_options.feedforward.actuator()

    @cached_property
    def model(self) -> LinearModel | None:
        """Linear model of [axis.model] and [axis.controller]; None without [axis.model]."""
        return linear_model(self.axis_options, self.rate_hz, recorded_driver_delay_ticks(self.recording))

    @property
    def static_gain(self) -> float:
        """Static gain D(0) of the axis's model, µm of position per µm of command; 1 without a model."""
        return self.model.static_gain if self.model else 1.0

    def row(
        self, name: str, quantity: str, unit: str, run: float, model: float | None = None, tolerance: float = 0.0
    ) -> Row:
        """Return the row of a quantity: its value `run` in this run and the `model`'s, both in `unit`.

        The run may miss the model by `tolerance`. The axis's specification gives the row's limit and claim under
        `name`; each is None where the specification does not have it.
        """
        return Row(
            quantity,
            unit,
            run,
            model,
            tolerance,
            required_limits(self.specification).get(name),
            self.specification.claims.get(name),
        )

    @property
    def first_trip(self) -> Trip | None:
        """Return {tick, causes} of the first trip, `causes` being a list of texts; None without a trip."""
        for event in self.recording.events:
            if event["kind"] == "tripped":
                return {"tick": event["tick"], "causes": event["what"]["causes"]}
        return None

    def require_complete(self) -> None:
        """Raise UnsuitableData for a run that was cut short, lost ticks, tripped or was clipped.

        Trips and clipping are no fault of a run that may trip. Clipping before the end of the approach to the middle of
        the motion is no fault either.
        """
        if self.first_trip and not self._may_trip:
            causes = ", ".join(self.first_trip["causes"])
            raise UnsuitableData(
                f"{self._label_prefix}the loop tripped at tick {self.first_trip['tick']} ({causes}); not analysed"
            )
        end_tick = self._ticks[-1] + 1 if self._ticks.size else 0
        if end_tick < self.planned_ticks:
            raise UnsuitableData(
                f"{self._label_prefix}the run ended after {end_tick} of the planned {self.planned_ticks} ticks "
                f"({end_tick / self.rate_hz:g} of {self.planned_ticks / self.rate_hz:g} s); not analysed"
            )
        if not self._may_trip and (clipping := clipping_text(self._flags())):
            raise UnsuitableData(
                f"{self._label_prefix}{clipping}; the recording shows the limit, not the loop; not analysed. "
                "Use a smaller amplitude"
            )
        if missing_ticks := int(end_tick) - self._ticks.size:
            raise UnsuitableData(
                f"{self._label_prefix}{missing_ticks} ticks are missing from the recording; not analysed"
            )

    def _flags(self) -> Real:
        """Return a copy of the recorded flags (ticks,), with 0 up to the end of the approach to the motion's middle.

        Near 0 V, before that end, noise alone clips a drive of one sign.
        """
        flags = self.recording["flags"].copy()
        if approaches := self.segments_labelled(APPROACH):
            flags[: approaches[-1].tick_slice.stop] = 0
        return flags

    def signal(self, name: str) -> Real:
        """Return a signal (ticks,) of the axis; `name` is without the axis, such as "position_um".

        Reference, position and command are relative to the middle of the run's motion.
        """
        return self.read(name)[0]

    def read(self, *names: str) -> list[Real]:
        """Return signals (ticks,) of the axis, read in one pass; `names` are without the axis, such as "position_um".

        Reference, position and command are relative to the middle of the run's motion.
        """
        signals = self.recording.read(*(f"{self.axis}_{name}" for name in names))
        if self.middle_um:
            signals = [
                signal - self.middle_um if name in CENTRED else signal
                for name, signal in zip(names, signals, strict=True)
            ]
        return signals

    def segments_labelled(self, *labels: str) -> list[Segment]:
        """Return the segments that have one of these labels, in the order of time."""
        return [segment for segment in self.segments if segment.label in labels]

    def shortest_duration_s(self, label: str) -> float:
        """Return the duration in s of the shortest segment with a label. Raises ValueError if there is none."""
        return min(segment.ticks for segment in self.segments_labelled(label)) / self.rate_hz

    @property
    def simulated_hysteresis(self) -> str | None:
        """Model that simulated the actuator's hysteresis: option hysteresis.truth of the plant, "residual" by default.

        None for drivers other than "sim" and "shm".
        """
        driver = self.configuration["driver"]
        if driver["kind"] not in ("sim", "shm"):
            return None
        plant = driver.get("plants", {}).get(self.axis) or driver.get("plant", {})
        return plant.get("hysteresis", {}).get("truth", "residual")

    @cached_property
    def _ticks(self) -> Real:
        """Numbers of the recorded ticks (ticks,)."""
        return self.recording["tick"]

    @property
    def _label_prefix(self) -> str:
        """The run's label with a colon, for messages; "" without a label."""
        return f"{self.label}: " if self.label else ""


def clipping_text(flags: Real) -> str | None:
    """Describe how many ticks the limits of command and drive clipped, and the first; None without clipping.

    `flags` (ticks,) is the recorded signal; ticks count from its beginning, from 0.
    """
    values = flags.astype(np.int64)
    messages = []
    for flag, name in ((Flag.COMMAND_LIMITED, "the command"), (Flag.DRIVE_LIMITED, "the drive")):
        ticks = np.flatnonzero(values & flag)
        if ticks.size:
            messages.append(f"{name} was clipped in {ticks.size} ticks, the first of them tick {ticks[0]}")
    return "; ".join(messages) or None
