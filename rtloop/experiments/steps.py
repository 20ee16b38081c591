"""Fig 10: a series of steps in closed loop, and one of them in detail."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import Field

from hil.options import Numbers, Options
from rtloop.experiments import paper
from rtloop.experiments.procedure import CLOSED_PEAK, Experiment, Run, Setting, hold
from rtloop.experiments.taken import Taken
from rtloop.experiments.theme import Ink
from rtloop.experiments.traces import envelope
from rtloop.experiments.verdict import Analysis, Row, Table
from rtloop.steps import StepMetrics, step_metrics

REST_S, SHOWN_S = 0.1, 0.03


class StepsOptions(Options):
    """The reference."""

    levels_um: Numbers = Field(default=(20.0, 0.0, -20.0, 0.0, 10.0, 30.0, 10.0, 0.0), min_length=1)
    dwell_s: float = Field(default=1.5, ge=0.05)
    """The paper's: as long as its figure shows each level."""


def runs(options: StepsOptions, setting: Setting) -> list[Run]:
    """Level after level."""
    timeline = setting.timeline()
    timeline.add("rest", "closed_loop", hold(0.0), REST_S)
    for level in options.levels_um:
        timeline.add("level", "closed_loop", hold(level), options.dwell_s, level_um=level)
    return [Run("", timeline)]


def analyse(recordings: Sequence[Taken], _: StepsOptions) -> Analysis:
    """Overshoot, settling and static error of every step; the middle one of each stands in the verdicts."""
    (taken,) = recordings
    reference, position, command, drive = taken.read("reference_um", "position_um", "command_um", "drive_v")
    found: list[tuple[float, float, StepMetrics, float]] = []
    zooms = []
    shown = round(SHOWN_S * taken.rate_hz)
    before = 0.0
    for segment in taken.labelled("level"):
        start, end, level = segment.start_tick, segment.start_tick + segment.ticks, segment.values["level_um"]
        metrics = step_metrics(reference[start - 1 : end], position[start - 1 : end], taken.rate_hz)
        if metrics is not None:
            height = level - before
            moved = (command[start:end] - command[start - 1]) / height
            found.append((before, level, metrics, float(moved.max())))
            zooms.append((position[start : start + shown] - before) / height)
        before = level
    overshoot, settling, static, peak = (float(np.median(values)) for values in zip(*map(_numbers, found), strict=True))
    rows = [
        Row("overshoot, median", "%", overshoot, paper.SAID_NO_OVERSHOOT, paper.CLOSED_OVERSHOOT_PERCENT, 0.3),
        Row("settling time to 5 %, median", "ms", settling, paper.SAID_SETTLING, paper.SETTLING_MS, 0.3),
        Row("static error, median", "%", static, paper.SAID_STATIC, paper.STATIC_PERCENT, 0.02),
        Row("peak of v per step, median", "1", peak, paper.SAID_COMMAND, paper.PEAK_COMMAND, 0.1),
    ]
    curves = {
        **{
            name: envelope(signal, taken.rate_hz)
            for name, signal in (("reference", reference), ("position", position), ("drive", drive))
        },
        "zoom_ms": 1e3 * np.arange(shown) / taken.rate_hz,
        "zooms": [zoom for zoom in zooms if zoom.size == shown],
    }
    notes = ["The model is C(s) of eq (20) with D(s) of eq (5) in continuous time, without hysteresis. The same "
             "equations at 10 kHz (tustin, prewarped at 595.5 Hz) overshoot by 1.38 % and settle in 4.1 ms with a peak "
             "of v of 1.396; the rest is the hysteresis that is left, which rings longer the smaller the step.",
             "The static error is the mean of the last fifth of a level against the reference: slow pole and "
             "hysteresis are still moving where the level is short."]  # fmt: skip
    return Analysis(rows, curves, (_table(found),), notes)


def _numbers(found: tuple[float, float, StepMetrics, float]) -> tuple[float, float, float, float]:
    _, _, metrics, peak = found
    return metrics.overshoot_percent, metrics.settling_time_ms, metrics.static_error_percent, peak


def _table(found: Sequence[tuple[float, float, StepMetrics, float]]) -> Table:
    rows = [[f"{one[0]:g} → {one[1]:g} µm", *(f"{value:.{digits}f}" for value, digits in
             zip(_numbers(one), (2, 1, 3, 2), strict=True))] for one in found]  # fmt: skip
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
    ink.label(series, "", "position / µm", "Fig 10-a: a series of steps")
    ink.legend(series)
    ink.label(drive, "time / s", "drive u / V")
    zoom.axhspan(0.95, 1.05, color=ink.faint, alpha=0.2, linewidth=0, label="±5 %")
    zoom.axvline(2.0, color=ink.paper, linewidth=1.0, linestyle="--", label="the paper: settled before 2 ms")
    for number, one in enumerate(curves["zooms"]):
        label = "each step, divided by its height" if number == 0 else None
        zoom.plot(curves["zoom_ms"], one, color=ink.measured, linewidth=1.0, alpha=0.6, label=label)
    time_s, position = paper.closed_step(SHOWN_S)
    zoom.plot(1e3 * time_s, position, color=ink.model, linewidth=1.2, label="eqs (5) and (20)")
    zoom.set_xlim(0, 1e3 * SHOWN_S / 2)
    ink.label(zoom, "time since the step / ms", "x per height of the step", "Fig 10-b: the steps in detail")
    ink.legend(zoom, loc="lower right")


EXPERIMENT = Experiment(
    "steps",
    "Closed-loop steps",
    "Fig 10",
    "Feedforward and feedback: a series of steps, each held for 1.5 s.",
    StepsOptions,
    runs,
    analyse,
    draw,
    commanded={"levels_um": CLOSED_PEAK},
    size=(11.0, 5.6),
)
