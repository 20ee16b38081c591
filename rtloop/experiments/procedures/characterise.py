"""The hysteresis under slow sines, beside the configuration's model with the same drive."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from rtloop.design.palette import Palette
from rtloop.experiments.procedure import Experiment
from rtloop.experiments.recorded_run import RecordedRun
from rtloop.experiments.setting import Setting
from rtloop.experiments.timeline import Run, Segment, sine
from rtloop.experiments.traces import thin_signals
from rtloop.experiments.verdict import Analysis, Table
from rtloop.foundation.options import Options
from rtloop.hysteresis.loop_shape import LoopShape, loop_shape
from rtloop.hysteresis.plays import model_output

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TOLERANCE_PERCENT, TOLERANCE_RATIO, FIT_TOLERANCE_PERCENT = 0.2, 0.005, 0.5
"""Expected agreement with the model: h/H in %, h and H as fractions of H, largest difference in % of H."""


class CharacteriseOptions(Options):
    """Options of the slow sines, which take half and all of the drive from its lowest to its highest value."""

    frequency_hz: float = Field(default=0.1, gt=0)
    """Frequency of the sines: slow enough for no lag, fast enough for no creep."""
    cycles: float = Field(default=2.0, ge=1.5)
    """Number of cycles of each loop."""


def runs(options: CharacteriseOptions, setting: Setting) -> list[Run]:
    """Plan one run without control: slow sines of half the drive, then of the whole drive, then of a minor loop.

    The sine of half the drive comes first, so that both sines begin on the initial loading curve. The minor loop is
    between 0 V and half of the end of the drive that is farther from 0 V.

    All sines begin at 0 V. The whole drive reaches from its lowest to its highest value, which need not be opposite.
    """
    timeline, (low_v, high_v) = setting.timeline("raw", uses_whole_drive=True), setting.drive_range_v
    middle_v, largest_v = (low_v + high_v) / 2, (high_v - low_v) / 2
    phase_deg = -math.degrees(math.asin(middle_v / largest_v))
    # A sine about 0 ends at 0 after each half cycle, any other after whole cycles alone.
    cycles = math.ceil(options.cycles) if middle_v else options.cycles
    for label, part in (("half", 0.5), ("major", 1.0)):
        reference = sine(part * largest_v, options.frequency_hz, part * middle_v, phase_deg)
        timeline.add(label, "raw", reference, cycles / options.frequency_hz, low_v=part * low_v, high_v=part * high_v)
    end_v = 0.5 * max(low_v, high_v, key=abs)
    minor = sine(0.5 * abs(end_v), options.frequency_hz, 0.5 * end_v, math.copysign(90.0, -end_v))
    ends_v = sorted((0.0, end_v))
    timeline.add("minor", "raw", minor, options.cycles / options.frequency_hz, low_v=ends_v[0], high_v=ends_v[1])
    return [Run("", timeline)]


def analyse(recordings: Sequence[RecordedRun], _: CharacteriseOptions) -> Analysis:
    """Compare the measured loops of one recording with the model's for the recorded drive.

    Rows: height h and range H of the largest loop, µm, h/H of all loops, %, each with its range of the drive, and the
    largest difference, % of H.
    """
    (run,) = recordings
    drive, position = run.read("drive_v", "position_um")
    rest_segment = run.segments_labelled("rest")[0]
    start = rest_segment.start_tick
    model = model_output(run.actuator_model, drive)[start:-1] * run.static_gain  # depolarising leaves a memory
    drive, position = drive[start:-1], position[start + 1 :]
    at_rest = slice(0, rest_segment.ticks // 2)
    position, model = position - position[at_rest].mean(), model - model[at_rest].mean()
    shapes: dict[str, tuple[LoopShape, LoopShape]] = {}
    curves: dict[str, object] = {}
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
    ranges = {segment.label: _range_text(segment) for segment in run.segments_labelled("half", "major", "minor")}
    curves["ranges"] = ranges
    major, model_major = shapes["major"]
    half, minor = shapes["half"], shapes["minor"]
    fit_percent, near_um = 100 * float(np.abs(error).max()) / major.width, TOLERANCE_RATIO * model_major.width
    drive_text = f"drive {ranges['major']}"
    rows = [
        run.row("hysteresis_percent", f"h/H, {drive_text}", "%", major.percent, model_major.percent, TOLERANCE_PERCENT),
        run.row("hysteresis_um", f"h, {drive_text}", "µm", major.height, model_major.height, near_um),
        run.row("range_um", f"H, {drive_text}", "µm", major.width, model_major.width, near_um),
        run.row(
            "", f"h/H, half of the drive, {ranges['half']}", "%", half[0].percent, half[1].percent, TOLERANCE_PERCENT
        ),
        run.row("", f"h/H, minor loop, {ranges['minor']}", "%", minor[0].percent, minor[1].percent, TOLERANCE_PERCENT),
        run.row("hysteresis_fit", "largest difference to the model", "% of H", fit_percent, 0.0, FIT_TOLERANCE_PERCENT),
    ]
    notes = ["The model is [axis.feedforward] times D(0), the static gain of [axis.model], driven with the recorded "
             "voltage.", *_range_notes(run)]  # fmt: skip
    if run.simulated_hysteresis == "residual":
        notes.append("The simulated actuator (option hysteresis.truth = \"residual\" of the plant) differs from the "
                     "model on purpose, so that some hysteresis remains after compensation.")  # fmt: skip
    return Analysis(rows, curves, (_table(shapes),), notes)


def _ends_v(segment: Segment) -> tuple[float, float]:
    """Return the lowest and the highest drive in V of a segment.

    Older recordings store one amplitude A: the ends are −A and A, those of the minor loop 0 and 2 A.
    """
    values = segment.values
    if "low_v" in values:
        return values["low_v"], values["high_v"]
    amplitude_v = values["amplitude_v"]
    return (0.0 if segment.label == "minor" else -amplitude_v), (2 if segment.label == "minor" else 1) * amplitude_v


def _range_text(segment: Segment) -> str:
    """Return the range of the drive in a segment: "±10 V" or "-2 … 10 V"."""
    low_v, high_v = _ends_v(segment)
    return f"±{high_v:.4g} V" if low_v == -high_v else f"{low_v:.4g} … {high_v:.4g} V"


def _range_notes(run: RecordedRun) -> list[str]:
    """Return a note if the largest loop leaves out a part of the drive that the limits allow; else []."""
    low_v, high_v = _ends_v(run.segments_labelled("major")[0])
    limits = run.axis_options.limits
    if low_v <= limits.lowest_v and limits.drive_v <= high_v:
        return []
    return [
        f"The limits allow a drive of {limits.lowest_v:g} … {limits.drive_v:g} V. The largest hysteresis loop was "
        "driven over a smaller range, because a larger drive would trip the interlock of position or sensor."
    ]


def _table(shapes: Mapping[str, tuple[LoopShape, LoopShape]]) -> Table:
    """Return a table of height h in µm, range H in µm and h/H in % of every loop, measured and modelled."""
    rows = [[label, *(f"{value:.3f}" for shape in pair for value in (shape.height, shape.width, shape.percent))]
            for label, pair in shapes.items()]  # fmt: skip
    return Table("Loops", ("loop", "h / µm", "H / µm", "h/H / %", "model: h", "H", "h/H"), rows)


def draw(figure: Figure, curves: Mapping[str, Any], ink: Palette) -> None:
    """Draw the measured loops, the modelled major loop, and measured minus modelled position over time.

    `curves` come from `analyse`.
    """
    grid = figure.add_gridspec(2, 2, height_ratios=(3, 1))
    loops, comparison, error = (figure.add_subplot(cell) for cell in (grid[0, 0], grid[0, 1], grid[1, :]))
    for label, color in (("major", ink.measured), ("half", ink.drive), ("minor", ink.comparison)):
        drive, position, _ = curves[label]
        loops.plot(drive, position, color=color, label=curves["ranges"][label])
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
    "The actuator is driven slowly, without any controller, through three loops: half of the drive, the whole drive "
    "from its lowest to its highest value, and a minor loop.",
    CharacteriseOptions,
    runs,
    analyse,
    draw,
    needs_controller=False,
    size=(11.0, 6.4),
)
