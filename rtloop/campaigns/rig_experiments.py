"""Experiments that every rig of a campaign goes through: the reference, the disturbance and the figures of each.

Figures are computed from the true position, without the sensor's noise, at POINTS places in each period.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from rtloop.configuration.reference_options import HoldOptions, ReferenceOptions, StepsOptions, WaveOptions
from rtloop.foundation.arrays import Real
from rtloop.foundation.options import AnyKind, Numbers, Options
from rtloop.recording.views.steps import measure_step

POINTS = 8
"""Places in each period, the tick included, at which the position is judged."""
SETTLING_BAND = 0.05
"""Part of a disturbance that may be left when it counts as settled."""
APPROACH_S = 0.5
"""Time in which a loop comes to rest in the middle of a stage of one sign."""
NAME = r"[A-Za-z][A-Za-z0-9_-]*"


class Motion(NamedTuple):
    """Reference (ticks,) in µm at each tick, and true position (ticks, POINTS) in µm, at `rate_hz`."""

    reference_um: Real
    position_um: Real
    rate_hz: float

    @property
    def error_um(self) -> Real:
        """Reference minus true position, (ticks, POINTS); between ticks the reference is interpolated."""
        ends_um = np.append(self.reference_um[1:], self.reference_um[-1])
        shares = np.arange(POINTS) / POINTS
        return self.reference_um[:, None] * (1 - shares) + ends_um[:, None] * shares - self.position_um

    def tick(self, time_s: float) -> int:
        """Return the number of the tick nearest to `time_s`; time and number are 0 at the first tick."""
        return round(time_s * self.rate_hz)


class ExperimentOptions(Options):
    """Base of all experiments: a name, with which the names of its figures begin, a reference and figures."""

    name: Annotated[str, Field(pattern=f"^{NAME}$")] = ""
    """Prefix of the names of the experiment's figures; by default the experiment's kind."""

    @property
    def label(self) -> str:
        """Name of the experiment: `name`, or its kind without one."""
        return self.name or str(getattr(self, "kind", ""))

    def about(self, middle_um: float) -> Self:
        """Return the experiment about `middle_um`, where it leaves its middle open; levels of steps stay."""
        return self

    @property
    def duration_s(self) -> float:
        """Duration of the experiment, from its first tick on."""
        raise NotImplementedError

    def ticks(self, rate_hz: float) -> int:
        """Return the experiment's duration in ticks at `rate_hz`, rounded to a whole number, at least 1."""
        return max(round(self.duration_s * rate_hz), 1)

    @property
    def reference(self) -> ReferenceOptions:
        """Reference of the axis; the other axes rest at 0."""
        raise NotImplementedError

    @property
    def disturbance(self) -> dict[str, float] | None:
        """Disturbance of the axis's plant, as the keys of `driver.plant.disturbance`; None for the configured one."""
        return None

    @property
    def figures(self) -> tuple[str, ...]:
        """Names of the figures, in the order of `measure`."""
        raise NotImplementedError

    def measure(self, motion: Motion) -> tuple[float, ...]:
        """Return the figures in the order of `figures`; infinity where a position is not finite or misses its level."""
        raise NotImplementedError


class StepsExperiment(ExperimentOptions):
    """Steps between levels, from rest at 0; figures are the worst of all steps that count.

    Overshoot and settling time are infinite if a step does not reach its level.
    """

    kind: Literal["steps"]
    """Selects steps of the reference, judged by overshoot, settling time and static error."""
    levels_um: Annotated[Numbers, Field(min_length=1, max_length=1000)]
    """Levels of the reference after a dwell at 0; each must differ from the one before it."""
    dwell_s: float = Field(default=0.1, gt=0, le=100)
    """Duration of each level, rounded to whole ticks."""
    cycles: int = Field(default=1, ge=1, le=1000)
    """Number of times that the levels are played."""
    first_step: bool | None = None
    """Whether the loop steps from rest to the first level; with false it enters there, as a run does, and that is no
    step. By default false for a drive of one sign, at whose end it rests. A single level is always a step."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Return the options; ValueError if the first level is 0 or a level equals the one before it."""
        if any(a == b for a, b in zip((0.0, *self.levels_um), self.levels_um, strict=False)):
            raise ValueError(
                f"levels_um: {list(self.levels_um)}; allowed: a first level other than 0, and each further level "
                "different from the level before"
            )
        return self

    def about(self, middle_um: float) -> Self:
        """Return the experiment with `first_step`, unless it is given: True for a middle at 0."""
        return self if self.first_step is not None else self.model_copy(update={"first_step": middle_um == 0.0})

    @property
    def duration_s(self) -> float:
        """Duration of one dwell before the first level, and of one at each level in every cycle."""
        return self.dwell_s * (1 + self.cycles * len(self.levels_um))

    def ticks(self, rate_hz: float) -> int:
        """Return the number of ticks: every level lasts the same whole number of periods."""
        return max(round(self.dwell_s * rate_hz), 1) * (1 + self.cycles * len(self.levels_um))

    @property
    def reference(self) -> ReferenceOptions:
        """The levels one after the other, after a dwell at 0 or, without a first step, at the first of them."""
        return StepsOptions(kind="steps", levels=self._all_levels_um, dwell_s=self.dwell_s, repeat=False)

    @property
    def _all_levels_um(self) -> tuple[float, ...]:
        """Levels of the reference, the one at which the loop begins included."""
        enters = self.first_step is False and len(set(self.levels_um)) > 1
        return (self.levels_um[0] if enters else 0.0, *self.cycles * self.levels_um)

    @property
    def figures(self) -> tuple[str, ...]:
        """Names of the figures: overshoot, settling time (to ±5 %) and static error of a step."""
        return ("overshoot_percent", "settling_ms", "static_error_percent")

    def measure(self, motion: Motion) -> tuple[float, ...]:
        """Return the largest overshoot (%), settling time (ms) and static error (%) of all steps that count.

        Overshoot and settling time are infinite if a step misses its level, all three if a position is not finite.
        """
        position_um = motion.position_um.ravel()
        dwell = POINTS * round(self.dwell_s * motion.rate_hz)
        steps = [
            measure_step(
                position_um[number * dwell - 1 : (number + 1) * dwell], after, after - before, POINTS * motion.rate_hz
            )
            for number, (before, after) in enumerate(pairwise(self._all_levels_um), start=1)
            if after != before
        ]
        return tuple(np.max(np.where(np.isnan(steps), np.inf, steps), axis=0).tolist())


class WaveExperiment(ExperimentOptions):
    """A sine, or as a scan a triangle, about `offset_um`; figures leave out the first `settle_periods`."""

    kind: Literal["sine", "scan"]
    """Selects a sine, or with "scan" a triangle, judged by the error's root mean square and peak."""
    amplitude_um: float = Field(gt=0)
    """Half the distance from peak to peak."""
    offset_um: float | None = None
    """Middle of the wave, which begins at its end next to 0; by default 0, for a drive of one sign the middle of the
    positions that it reaches."""
    frequency_hz: float = Field(gt=0)
    """Frequency of the wave; half of the loop's rate or more is refused."""
    periods: float = Field(default=5.0, gt=0, le=1e5)
    """Duration of the experiment in periods of the wave, `settle_periods` included."""
    settle_periods: float = Field(default=1.0, ge=0)
    """Periods at the beginning that no figure counts; fewer than `periods`."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Return the options; ValueError unless `settle_periods` is less than `periods`."""
        if self.settle_periods >= self.periods:
            raise ValueError(f"settle_periods: {self.settle_periods:g}; allowed: less than periods = {self.periods:g}")
        return self

    def about(self, middle_um: float) -> Self:
        """Return the wave with `offset_um` = `middle_um`, unless it is given."""
        return self if self.offset_um is not None else self.model_copy(update={"offset_um": middle_um})

    @property
    def duration_s(self) -> float:
        """Duration of all periods of the wave."""
        return self.periods / self.frequency_hz

    @property
    def reference(self) -> ReferenceOptions:
        """A sine or a triangle: about 0 from 0 on, else from the end next to 0."""
        kind, offset_um = "sine" if self.kind == "sine" else "triangle", self.offset_um or 0.0
        wave = WaveOptions(kind=kind, amplitude=self.amplitude_um, frequency_hz=self.frequency_hz)
        if not offset_um:
            return wave
        return wave.model_copy(update={"offset": offset_um, "phase_deg": math.copysign(90.0, -offset_um)})

    @property
    def figures(self) -> tuple[str, ...]:
        """Names of the figures: root mean square and largest magnitude of the error."""
        return ("error_rms_um", "error_peak_um")

    def measure(self, motion: Motion) -> tuple[float, ...]:
        """Return root mean square and largest magnitude of the error after `settle_periods`, in µm.

        Both figures are infinite if a position after these periods is not finite. Raises ValueError if no tick comes
        after them.
        """
        error_um = motion.error_um[motion.tick(self.settle_periods / self.frequency_hz) :]
        if not error_um.size:
            raise ValueError(
                f"settle_periods: {self.settle_periods:g}; no tick is left after these periods; raise periods"
            )
        if not np.all(np.isfinite(error_um)):
            return (math.inf,) * len(self.figures)
        return float(np.sqrt(np.mean(error_um**2))), float(np.max(np.abs(error_um)))


class DisturbanceExperiment(ExperimentOptions):
    """A step and a sine of disturbance on a held reference; figures count from the disturbance on.

    `settling_ms` is the time until the error stays within SETTLING_BAND of the step; it is 0 without a step.
    """

    kind: Literal["disturbance"]
    """Selects a disturbance of the position, judged by the error's peak, its root mean square and the settling time."""
    step_um: float = 0.0
    """Height of a constant disturbance; it or `sine_um` must differ from 0."""
    sine_um: float = 0.0
    """Amplitude of a sinusoidal disturbance."""
    sine_hz: float = Field(default=1.0, gt=0)
    """Frequency of the sinusoidal disturbance; half of the loop's rate or more is refused."""
    hold_um: float | None = None
    """Constant reference during the experiment; by default 0, for a drive of one sign the middle of the positions that
    it reaches."""
    start_s: float = Field(default=0.1, ge=0, le=100)
    """Time from the start of the experiment to the disturbance, in which the loop comes to rest; by default 0.5 s where
    a drive of one sign moves `hold_um` to the middle."""
    lasts_s: float = Field(default=0.2, gt=0, le=1000)
    """Time from the beginning of the disturbance to the end of the experiment, over which figures count."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Return the options; ValueError if `step_um` and `sine_um` are both 0."""
        if not (self.step_um or self.sine_um):
            raise ValueError("step_um and sine_um are 0; allowed: at least one other than 0")
        return self

    def about(self, middle_um: float) -> Self:
        """Return the experiment with `hold_um` = `middle_um`, unless it is given; a loop that has to go there gets
        APPROACH_S before the disturbance, unless `start_s` is given.
        """
        if self.hold_um is not None:
            return self
        waits = {"start_s": APPROACH_S} if middle_um and "start_s" not in self.model_fields_set else {}
        return self.model_copy(update={"hold_um": middle_um, **waits})

    @property
    def duration_s(self) -> float:
        """Time before the disturbance, and the time that it lasts."""
        return self.start_s + self.lasts_s

    @property
    def reference(self) -> ReferenceOptions:
        """A constant level, `hold_um`."""
        return HoldOptions(kind="hold", value=self.hold_um or 0.0)

    @property
    def disturbance(self) -> dict[str, float]:
        """Step and sine from `start_s` on: {step_um, sine_um, sine_hz, start_s}."""
        return {"step_um": self.step_um, "sine_um": self.sine_um, "sine_hz": self.sine_hz, "start_s": self.start_s}

    @property
    def figures(self) -> tuple[str, ...]:
        """Names of the figures: largest magnitude and root mean square of the error, settling time."""
        return ("error_peak_um", "error_rms_um", "settling_ms")

    def measure(self, motion: Motion) -> tuple[float, ...]:
        """Return largest magnitude and root mean square (µm) of the error from `start_s` on, and settling time (ms).

        The settling time counts from `start_s`. This time is 0 without a step, infinite if the error at the end is more
        than SETTLING_BAND of the step. All three are infinite if a position from `start_s` on is not finite.
        """
        error_um = np.abs(motion.error_um[motion.tick(self.start_s) :]).ravel()
        if not np.all(np.isfinite(error_um)):
            return (math.inf,) * len(self.figures)
        outside = np.flatnonzero(error_um > SETTLING_BAND * abs(self.step_um)) if self.step_um else np.empty(0)
        settled = int(outside[-1]) + 1 if outside.size else 0
        settling_ms = math.inf if settled == error_um.size else 1e3 * settled / (POINTS * motion.rate_hz)
        return float(np.max(error_um)), float(np.sqrt(np.mean(error_um**2))), settling_ms


Experiment = Annotated[StepsExperiment | WaveExperiment | DisturbanceExperiment, Field(discriminator="kind"), AnyKind]
