"""The hysteresis under slow sines, beside the configuration's model with the same drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import Field

from rtloop.design.palette import Palette
from rtloop.experiments.procedure import Experiment
from rtloop.experiments.recorded_run import RecordedRun
from rtloop.experiments.setting import Setting
from rtloop.experiments.timeline import Run, sine
from rtloop.experiments.traces import thin_signals
from rtloop.experiments.verdict import Analysis, Table
from rtloop.foundation.options import Options
from rtloop.hysteresis.loop_shape import LoopShape, loop_shape
from rtloop.hysteresis.plays import model_output

TOLERANCE_PERCENT, TOLERANCE_RATIO, FIT_TOLERANCE_PERCENT = 0.2, 0.005, 0.5
"""Expected agreement with the model: h/H in %, h and H as fractions of H, largest difference in % of H."""


class CharacteriseOptions(Options):
    """Options of the slow sines, whose amplitudes are fractions of the drive limit."""

    frequency_hz: float = Field(default=0.1, gt=0)
    """Slow enough for no lag, fast enough for no creep."""
    cycles: float = Field(default=2.0, ge=1.5)
    """Number of cycles of each loop."""


def runs(options: CharacteriseOptions, setting: Setting) -> list[Run]:
    """Plan half the drive, then all of it, so that both begin with their initial loading curve, then a minor loop."""
    timeline, largest_v = setting.timeline("raw"), setting.reach_v
    duration_s = options.cycles / options.frequency_hz
    for label, amplitude_v in (("half", 0.5 * largest_v), ("major", largest_v)):
        timeline.add(label, "raw", sine(amplitude_v, options.frequency_hz), duration_s, amplitude_v=amplitude_v)
    minor = sine(0.25 * largest_v, options.frequency_hz, 0.25 * largest_v, -90.0)
    timeline.add("minor", "raw", minor, duration_s, amplitude_v=0.25 * largest_v)
    return [Run("", timeline)]


def analyse(recordings: Sequence[RecordedRun], _: CharacteriseOptions) -> Analysis:
    """Compare the measured loops with the model's for the recorded drive.

    Rows: height h and range H of the loop over the whole drive, µm, h/H of all loops, %, and the largest difference, %
    of H.
    """
    (run,) = recordings
    drive, position = run.read("drive_v", "position_um")
    rest_segment = run.segments_labelled("rest")[0]
    start = rest_segment.start_tick
    drive, position = drive[start:-1], position[start + 1 :]
    position = position - position[: rest_segment.ticks // 2].mean()
    model = model_output(run.actuator_model, drive) * run.static_gain
    shapes: dict[str, tuple[LoopShape, LoopShape]] = {}
    curves: dict[str, Any] = {}
    for segment in run.segments_labelled("half", "major", "minor"):
        rows_of_segment = slice(segment.start_tick - start, segment.start_tick - start + segment.ticks - 1)
        shapes[segment.label] = (
            loop_shape(drive[rows_of_segment], position[rows_of_segment]),
            loop_shape(drive[rows_of_segment], model[rows_of_segment]),
        )
        curves[segment.label] = thin_signals(drive[rows_of_segment], position[rows_of_segment], model[rows_of_segment])
    error = position - model
    error -= error.mean()
    curves["error"] = thin_signals(np.arange(drive.size) / run.rate_hz, error)
    major, model_major = shapes["major"]
    half, minor = shapes["half"], shapes["minor"]
    fit_percent, near_um = 100 * float(np.abs(error).max()) / major.width, TOLERANCE_RATIO * model_major.width
    rows = [
        run.row("hysteresis_percent", "h/H, whole range", "%", major.percent, model_major.percent, TOLERANCE_PERCENT),
        run.row("hysteresis_um", "h, whole range", "µm", major.height, model_major.height, near_um),
        run.row("range_um", "H, whole range", "µm", major.width, model_major.width, near_um),
        run.row("", "h/H, half the range", "%", half[0].percent, half[1].percent, TOLERANCE_PERCENT),
        run.row("", "h/H, minor loop", "%", minor[0].percent, minor[1].percent, TOLERANCE_PERCENT),
        run.row("hysteresis_fit", "largest difference to the model", "% of H", fit_percent, 0.0, FIT_TOLERANCE_PERCENT),
    ]
    notes = ["The model is [axis.feedforward] times D(0), the static gain of [axis.model], driven with the recorded "
             "voltage."]  # fmt: skip
    if run.simulated_hysteresis == "residual":
        notes.append("The simulated actuator (truth = \"residual\") differs from the model on purpose, so that some "
                     "hysteresis remains after compensation.")  # fmt: skip
    return Analysis(rows, curves, (_table(shapes),), notes)


def _table(shapes: Mapping[str, tuple[LoopShape, LoopShape]]) -> Table:
    """Return a table of height h, width H and h/H of every loop, measured and modelled."""
    rows = [[label, *(f"{value:.3f}" for shape in pair for value in (shape.height, shape.width, shape.percent))]
            for label, pair in shapes.items()]  # fmt: skip
    return Table("Loops", ("loop", "h / µm", "H / µm", "h/H / %", "model: h", "H", "h/H"), rows)


def draw(figure: Any, curves: Mapping[str, Any], ink: Palette) -> None:
    """Draw the loops, the model over the major loop, and their difference over time."""
    grid = figure.add_gridspec(2, 2, height_ratios=(3, 1))
    loops, comparison, error = (figure.add_subplot(cell) for cell in (grid[0, 0], grid[0, 1], grid[1, :]))
    for label, color in (("major", ink.measured), ("half", ink.drive), ("minor", ink.comparison)):
        drive, position, _ = curves[label]
        loops.plot(drive, position, color=color, label={"half": "half the range"}.get(label, f"{label} loop"))
    ink.label(loops, "drive u / V", "position x / µm", "hysteresis under slow sines", legend="best")
    drive, position, model = curves["major"]
    comparison.plot(drive, position, color=ink.measured, linewidth=3.0, alpha=0.55, label="measured")
    comparison.plot(drive, model, color=ink.model, linewidth=1.0, label="model, same drive")
    ink.label(comparison, "drive u / V", "position x / µm", "measured and model", legend="best")
    error.plot(*curves["error"], color=ink.error, linewidth=0.9)
    error.margins(x=0)
    ink.label(error, "time / s", "difference / µm")


EXPERIMENT = Experiment(
    "characterise",
    "Hysteresis under slow sines, and its model",
    "The actuator is driven slowly, without any controller: half the drive, all of it, a minor loop.",
    CharacteriseOptions,
    runs,
    analyse,
    draw,
    needs_controller=False,
    size=(11.0, 6.4),
)
