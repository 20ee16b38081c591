"""A series of steps in closed loop, and all of them in detail."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from rtloop.design.identification.measured import UnsuitableData
from rtloop.experiments.procedure import Experiment, Run, Segment, hold
from rtloop.experiments.setting import Setting
from rtloop.experiments.taken import Taken
from rtloop.experiments.theme import Ink
from rtloop.experiments.traces import envelope
from rtloop.experiments.verdict import Analysis, Table
from rtloop.hil.modal import Real
from rtloop.hil.options import Numbers, Options
from rtloop.recording.views.steps import StepMetrics, step_metrics

REST_S, SHOWN_SETTLINGS = 0.1, 5.0
OVERSHOOT_NEAR, STATIC_NEAR, PEAK_NEAR = 0.3, 0.02, 0.1
SETTLING_NEAR_MS, SETTLING_NEAR = 0.3, 0.05
"""How near the model a run is expected to be: % of a step, command per height, ms and a part of the settling time."""


class StepsOptions(Options):
    """The reference."""

    levels_um: Numbers = Field(default=(20.0, 0.0, -20.0, 0.0, 10.0, 30.0, 10.0, 0.0), min_length=1)
    dwell_s: float = Field(default=1.5, ge=0.05)
    """Of each level."""


def runs(options: StepsOptions, setting: Setting) -> list[Run]:
    """Level after level."""
    timeline = setting.timeline()
    timeline.add("rest", "closed_loop", hold(0.0), REST_S)
    for level in options.levels_um:
        timeline.add("level", "closed_loop", hold(level), options.dwell_s, level_um=level)
    return [Run("", timeline)]


class Step(NamedTuple):
    """One step: from where to where, what came of it, the largest command per height."""

    before_um: float
    level_um: float
    metrics: StepMetrics
    peak: float

    @property
    def numbers(self) -> tuple[float, float, float, float]:
        """Overshoot %, settling ms, static error %, peak."""
        of = self.metrics
        return of.overshoot_percent, of.settling_time_ms, of.static_error_percent, self.peak


def analyse(recordings: Sequence[Taken], _: StepsOptions) -> Analysis:
    """Overshoot, settling and static error of every step; the middle one of each stands in the verdicts."""
    (taken,) = recordings
    reference, position, command, drive = taken.read("reference_um", "position_um", "command_um", "drive_v")
    found = _steps(taken, reference, position, command)
    if not found:
        raise UnsuitableData("no level differs from the one before, or none is held for long enough")
    middle = np.median([one.numbers for one in found], axis=0)
    start = taken.labelled("rest")[0].start_tick
    answer = taken.model.closed_answer(reference[start:]) if taken.model else None
    modelled: list[Step] = []
    if answer is not None:
        answer = np.concatenate([np.zeros((2, start)), answer], axis=1)
        modelled = _steps(taken, reference, *answer)
    model = [float(value) for value in np.median([one.numbers for one in modelled], axis=0)] if modelled else [None] * 4
    settling_near = max(SETTLING_NEAR_MS, SETTLING_NEAR * (model[1] or 0.0))
    rows = [
        taken.row("overshoot_percent", "overshoot, median", "%", middle[0], model[0], OVERSHOOT_NEAR),
        taken.row("settling_ms", "settling time to 5 %, median", "ms", middle[1], model[1], settling_near),
        taken.row("static_error_percent", "static error, median", "%", middle[2], model[2], STATIC_NEAR),
        taken.row("peak_command", "peak of v per step, median", "1", middle[3], model[3], PEAK_NEAR),
    ]
    shown = round(min(SHOWN_SETTLINGS * max(middle[1], 1.0) / 1e3, taken.shortest("level")) * taken.rate_hz)
    curves = {
        **{
            name: envelope(signal, taken.rate_hz)
            for name, signal in (("reference", reference), ("position", position), ("drive", drive))
        },
        "zoom_ms": 1e3 * np.arange(shown) / taken.rate_hz,
        "zooms": _laid_over(taken, position, shown),
        "model": None if answer is None else _laid_over(taken, answer[0], shown)[0],
        "asked_ms": taken.asked.settling_ms,
        "claimed": taken.asked.claims.get("settling_ms"),
    }
    notes = ["The model is the loop of [axis.controller] and [axis.model] as it runs, given the recorded reference, "
             "without hysteresis: what is left of that rings longer the smaller the step.",
             "The static error is the mean of the last fifth of a level against the reference: a slow pole and the "
             "hysteresis are still moving where the level is short."]  # fmt: skip
    return Analysis(rows, curves, (_table(found),), notes)


def _steps(taken: Taken, reference: Real, position: Real, command: Real) -> list[Step]:
    """Of every level that differs from the one before."""
    found = []
    for segment, before, level in _changes(taken):
        start, end = segment.start_tick, segment.start_tick + segment.ticks
        metrics = step_metrics(reference[start - 1 : end], position[start - 1 : end], taken.rate_hz)
        if metrics is not None:
            moved = (command[start:end] - command[start - 1]) / (level - before)
            found.append(Step(before, level, metrics, float(moved.max())))
    return found


def _laid_over(taken: Taken, position: Real, ticks: int) -> list[Real]:
    """The first ticks of every step, divided by its height."""
    return [
        (position[segment.start_tick : segment.start_tick + ticks] - before) / (level - before)
        for segment, before, level in _changes(taken)
    ]


def _changes(taken: Taken) -> Iterator[tuple[Segment, float, float]]:
    """Every level that differs from the one before, with both in µm."""
    before = 0.0
    for segment in taken.labelled("level"):
        level = segment.values["level_um"]
        if level != before:
            yield segment, before, level
        before = level


def _table(found: Sequence[Step]) -> Table:
    rows = [[f"{one.before_um:g} → {one.level_um:g} µm", *(f"{value:.{digits}f}" for value, digits in
             zip(one.numbers, (2, 1, 3, 2), strict=True))] for one in found]  # fmt: skip
    headings = ("step", "overshoot / %", "settling / ms", "static error / %", "peak of v per step")
    return Table("Every step", headings, rows)


def draw(figure: Any, curves: Mapping[str, Any], ink: Ink) -> None:
    """The series with its drive, and all steps laid over each other."""
    grid = figure.add_gridspec(2, 2, height_ratios=(2, 1), width_ratios=(3, 2))
    series, drive, zoom = (figure.add_subplot(place) for place in (grid[0, 0], grid[1, 0], grid[:, 1]))
    series.plot(*curves["position"], color=ink.measured, label="position x")
    series.plot(*curves["reference"], color=ink.model, linewidth=0.8, label="reference")
    drive.plot(*curves["drive"], color=ink.drive, linewidth=0.9)
    for panel in (series, drive):
        panel.margins(x=0)
    series.tick_params(labelbottom=False)
    ink.label(series, "", "position / µm", "a series of steps")
    ink.legend(series)
    ink.label(drive, "time / s", "drive u / V")
    zoom.axhspan(0.95, 1.05, color=ink.faint, alpha=0.2, linewidth=0, label="±5 %")
    if (asked_ms := curves["asked_ms"]) is not None:
        zoom.axvline(
            asked_ms, color=ink.asked, linewidth=1.0, linestyle="--", label=f"asked: settled in {asked_ms:g} ms"
        )
    if (claim := curves["claimed"]) is not None and claim.at_most is not None:
        zoom.axvline(claim.at_most, color=ink.asked, linewidth=1.0, linestyle=":", label=f"claimed: {claim.says}")
    for number, one in enumerate(curves["zooms"]):
        label = "each step, divided by its height" if number == 0 else None
        zoom.plot(curves["zoom_ms"], one, color=ink.measured, linewidth=1.0, alpha=0.6, label=label)
    if (other := curves.get("beside")) is not None:
        for number, one in enumerate(other["zooms"]):
            label = f"the same with {other['name']}" if number == 0 else None
            zoom.plot(other["zoom_ms"], one, color=ink.other, linewidth=1.0, alpha=0.8, label=label)
    if curves["model"] is not None:
        zoom.plot(curves["zoom_ms"], curves["model"], color=ink.model, linewidth=1.2, label="model")
    zoom.set_xlim(0, curves["zoom_ms"][-1])
    ink.label(zoom, "time since the step / ms", "x per height of the step", "the steps in detail")
    ink.legend(zoom, loc="lower right")


EXPERIMENT = Experiment(
    "steps",
    "Closed-loop steps",
    "Feedforward and feedback: a series of steps.",
    StepsOptions,
    runs,
    analyse,
    draw,
    largest={"levels_um": lambda setting: setting.largest_step_um},
    size=(11.0, 5.6),
)
