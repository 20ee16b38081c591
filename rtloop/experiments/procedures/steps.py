"""A series of steps in closed loop, and all of them in detail."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import Field

from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.palette import Palette
from rtloop.experiments.largest_amplitudes import largest_step_down, largest_step_up
from rtloop.experiments.procedure import Experiment
from rtloop.experiments.recorded_run import RecordedRun
from rtloop.experiments.setting import Setting
from rtloop.experiments.timeline import Run, Segment, hold
from rtloop.experiments.traces import envelope
from rtloop.experiments.verdict import Analysis, Table
from rtloop.foundation.arrays import Real
from rtloop.foundation.options import Numbers, Options
from rtloop.recording.views.steps import StepMetrics, step_metrics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN_SETTLINGS = 5.0
OVERSHOOT_TOLERANCE, STATIC_TOLERANCE, PEAK_TOLERANCE = 0.3, 0.02, 0.1
SETTLING_TOLERANCE_MS, SETTLING_TOLERANCE = 0.3, 0.05
"""Expected agreement with the model: % of a step, command per height, ms and a fraction of the settling time."""


class StepsOptions(Options):
    """Options: levels of the reference, and their duration."""

    levels_um: Numbers = Field(default=(20.0, 0.0, -20.0, 0.0, 10.0, 30.0, 10.0, 0.0), min_length=1)
    """Levels of the reference, one after the other, reduced by default to fit limits and interlocks."""
    dwell_s: float = Field(default=1.5, ge=0.05)
    """Duration in s of each level."""


def runs(options: StepsOptions, setting: Setting) -> list[Run]:
    """Plan one run in closed loop: rest, then one level of the reference after the other."""
    timeline = setting.timeline("closed_loop")
    for level in options.levels_um:
        timeline.add("level", "closed_loop", hold(level), options.dwell_s, level_um=level)
    return [Run("", timeline)]


class Step(NamedTuple):
    """Result of one step: its levels, its figures, and the largest change of the command per height (`peak`)."""

    before_um: float
    level_um: float
    metrics: StepMetrics
    peak: float

    @property
    def figures(self) -> tuple[float, float, float, float]:
        """Overshoot in %, settling in ms, static error in %, peak of the command per height."""
        metrics = self.metrics
        return metrics.overshoot_percent, metrics.settling_time_ms, metrics.static_error_percent, self.peak


def analyse(recordings: Sequence[RecordedRun], _: StepsOptions) -> Analysis:
    """Evaluate overshoot, settling and static error of every step, from one recording; the rows have their medians.

    Raises UnsuitableData if no level differs from the level before it and lasts long enough.
    """
    (run,) = recordings
    reference, position, command, drive = run.read("reference_um", "position_um", "command_um", "drive_v")
    measured_steps = _evaluate_steps(run, reference, position, command)
    if not measured_steps:
        raise UnsuitableData(
            "no step to evaluate: every level equals the level before it, or is too short. Use other steps.levels_um, "
            "or a longer steps.dwell_s"
        )
    median_figures = np.median([step.figures for step in measured_steps], axis=0)
    start = run.segments_labelled("rest")[0].start_tick
    model_signals = run.model.closed_response(reference[start:]) if run.model else None
    model_steps: list[Step] = []
    if model_signals is not None:
        model_signals = np.concatenate([np.zeros((2, start)), model_signals], axis=1)
        model_steps = _evaluate_steps(run, reference, *model_signals)
    model_figures = (
        [float(value) for value in np.median([step.figures for step in model_steps], axis=0)]
        if model_steps
        else [None] * 4
    )
    settling_tolerance = max(SETTLING_TOLERANCE_MS, SETTLING_TOLERANCE * (model_figures[1] or 0.0))
    rows = [
        run.row(
            "overshoot_percent", "overshoot, median", "%", median_figures[0], model_figures[0], OVERSHOOT_TOLERANCE
        ),
        run.row(
            "settling_ms", "settling time to 5 %, median", "ms", median_figures[1], model_figures[1], settling_tolerance
        ),
        run.row(
            "static_error_percent", "static error, median", "%", median_figures[2], model_figures[2], STATIC_TOLERANCE
        ),
        run.row(
            "peak_command", "peak of v per unit step, median", "1", median_figures[3], model_figures[3], PEAK_TOLERANCE
        ),
    ]
    shown_ticks = round(
        min(SHOWN_SETTLINGS * max(median_figures[1], 1.0) / 1e3, run.shortest_duration_s("level")) * run.rate_hz
    )
    curves = {
        **{
            name: envelope(signal[start if run.middle_um else 0 :], run.rate_hz)
            for name, signal in (("reference", reference), ("position", position), ("drive", drive))
        },
        "zoom_ms": 1e3 * np.arange(shown_ticks) / run.rate_hz,
        "zooms": _scaled_steps(run, position, shown_ticks),
        "model": None if model_signals is None else _scaled_steps(run, model_signals[0], shown_ticks)[0],
        "asked_ms": run.specification.settling_ms,
        "claimed": run.specification.claims.get("settling_ms"),
    }
    notes = ["The model is the sampled loop of [axis.controller] and [axis.model] with the recorded reference, without "
             "hysteresis. The remaining hysteresis makes smaller steps ring longer.",
             "The static error is the difference between the reference and the mean position in the last fifth of a "
             "level. In a short level, a slow pole and the hysteresis have not settled."]  # fmt: skip
    return Analysis(rows, curves, (_steps_table(measured_steps),), notes)


def _evaluate_steps(run: RecordedRun, reference: Real, position: Real, command: Real) -> list[Step]:
    """Return a Step for every level that differs from the level before it and lasts long enough to be evaluated.

    `reference`, `position` and `command` (ticks,) cover the whole run, measured or by the model.
    """
    steps = []
    for segment, previous_um, level in _level_changes(run):
        start, end = segment.start_tick, segment.start_tick + segment.ticks
        metrics = step_metrics(reference[start - 1 : end], position[start - 1 : end], run.rate_hz)
        if metrics is not None:
            command_ratio = (command[start:end] - command[start - 1]) / (level - previous_um)
            steps.append(Step(previous_um, level, metrics, float(command_ratio.max())))
    return steps


def _scaled_steps(run: RecordedRun, position: Real, ticks: int) -> list[Real]:
    """Return (position − level before it)/height in the first `ticks` of every step, without unit, (ticks,) each.

    `ticks` must not exceed the shortest level, as the next level would follow in its place.
    """
    return [
        (position[segment.start_tick : segment.start_tick + ticks] - previous_um) / (level - previous_um)
        for segment, previous_um, level in _level_changes(run)
    ]


def _level_changes(run: RecordedRun) -> Iterator[tuple[Segment, float, float]]:
    """Yield (segment, level before it in µm, level in µm) for every level that differs from the level before it."""
    previous_um = 0.0
    for segment in run.segments_labelled("level"):
        level = segment.values["level_um"]
        if level != previous_um:
            yield segment, previous_um, level
        previous_um = level


def _steps_table(steps: Sequence[Step]) -> Table:
    """Return a table with a row for each step.

    Its columns are levels in µm, overshoot in %, settling time in ms, static error in %, and the peak of the command
    per height of the step.
    """
    rows = [[f"{step.before_um:g} → {step.level_um:g} µm", *(f"{value:.{digits}f}" for value, digits in
             zip(step.figures, (2, 1, 3, 2), strict=True))] for step in steps]  # fmt: skip
    headings = ("step", "overshoot / %", "settling / ms", "static error / %", "peak of v per unit step")
    return Table("Every step", headings, rows)


def draw(figure: Figure, curves: Mapping[str, Any], ink: Palette) -> None:
    """Draw the series with its drive, and all steps over each other; `curves` come from `analyse`."""
    grid = figure.add_gridspec(2, 2, height_ratios=(2, 1), width_ratios=(3, 2))
    series, drive, zoom = (figure.add_subplot(cell) for cell in (grid[0, 0], grid[1, 0], grid[:, 1]))
    series.plot(*curves["position"], color=ink.measured, label="position x")
    series.plot(*curves["reference"], color=ink.model, linewidth=0.8, label="reference")
    drive.plot(*curves["drive"], color=ink.drive, linewidth=0.9)
    for panel in (series, drive):
        panel.margins(x=0)
    series.tick_params(labelbottom=False)
    ink.label(series, "", "position / µm", "a series of steps", legend="best")
    ink.label(drive, "time / s", "drive u / V")
    zoom.axhspan(0.95, 1.05, color=ink.faint, alpha=0.2, linewidth=0, label="±5 %")
    if (limit_ms := curves["asked_ms"]) is not None:
        zoom.axvline(
            limit_ms, color=ink.limit, linewidth=1.0, linestyle="--", label=f"required: settled in {limit_ms:g} ms"
        )
    if (claim := curves["claimed"]) is not None and claim.at_most is not None:
        zoom.axvline(claim.at_most, color=ink.limit, linewidth=1.0, linestyle=":", label=f"claimed: {claim.says}")
    for number, trace in enumerate(curves["zooms"]):
        label = "each step, divided by its height" if number == 0 else None
        zoom.plot(curves["zoom_ms"], trace, color=ink.measured, linewidth=1.0, alpha=0.6, label=label)
    if (comparison := curves.get("beside")) is not None:
        for number, trace in enumerate(comparison["zooms"]):
            label = f"the same with {comparison['name']}" if number == 0 else None
            zoom.plot(comparison["zoom_ms"], trace, color=ink.comparison, linewidth=1.0, alpha=0.8, label=label)
    if curves["model"] is not None:
        zoom.plot(curves["zoom_ms"], curves["model"], color=ink.model, linewidth=1.2, label="model")
    zoom.set_xlim(0, curves["zoom_ms"][-1])
    ink.label(zoom, "time since the step / ms", "x per height of the step", "the steps in detail", legend="lower right")


EXPERIMENT = Experiment(
    "steps",
    "Closed-loop steps",
    "Feedforward and feedback: a series of steps.",
    StepsOptions,
    runs,
    analyse,
    draw,
    limits={"levels_um": largest_step_up},
    lower_limits={"levels_um": largest_step_down},
    size=(11.0, 5.6),
)
