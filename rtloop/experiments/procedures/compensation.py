"""The error of the inverse hysteresis without feedback."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypedDict

import numpy as np
from pydantic import Field

from rtloop.design.palette import Palette
from rtloop.experiments.largest_amplitudes import largest_command
from rtloop.experiments.procedure import Experiment
from rtloop.experiments.recorded_run import RecordedRun
from rtloop.experiments.setting import Setting
from rtloop.experiments.timeline import Run, Segment, sine
from rtloop.experiments.traces import thin_signals
from rtloop.experiments.verdict import Analysis
from rtloop.foundation.arrays import Real
from rtloop.foundation.options import Options
from rtloop.hysteresis.loop_shape import loop_shape
from rtloop.hysteresis.plays import model_output

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TOLERANCE = 0.1
"""Expected agreement with the model: % of h/H, and µm."""


class CompensationOptions(Options):
    """Options of the slow sine of the command v."""

    amplitude_um: float = Field(default=40.0, gt=0)
    """Amplitude of the command, reduced by default to fit limits and interlocks."""
    frequency_hz: float = Field(default=0.1, gt=0)
    """Frequency of the command: slow enough for no lag, fast enough for no creep."""
    cycles: float = Field(default=2.0, ge=1.5)
    """Number of cycles, of which the first half cycle is left out."""


def runs(options: CompensationOptions, setting: Setting) -> list[Run]:
    """Plan one run with feedforward alone: rest, then a slow sine of the command."""
    timeline = setting.timeline("feedforward")
    timeline.add(
        "sine",
        "feedforward",
        sine(options.amplitude_um, options.frequency_hz),
        options.cycles / options.frequency_hz,
    )
    return [Run("", timeline)]


class CompensationCurves(TypedDict):
    """Command v, output y and v − y in µm."""

    v_y_error: tuple[Real, ...]


def analyse(recordings: Sequence[RecordedRun], options: CompensationOptions) -> Analysis[CompensationCurves]:
    """Evaluate the output y = x/D(0) of the compensation over the command v, both in µm, from one recording.

    x is the position relative to rest, D(0) the static gain of the dynamics. Rows: height h of the remaining loop, µm,
    and h over its range H, %; largest |v − y|; slope ρ of y over v, fitted without the first half cycle; largest
    |Ω| = |y − ρ v|.
    """
    (run,) = recordings
    reference, position, drive = run.read("reference_um", "position_um", "drive_v")
    rest_segment, segment = run.segments_labelled("rest")[0], run.segments_labelled("sine")[0]
    offset = position[rest_segment.tick_slice].mean()
    ticks = segment.tick_slice
    v, y = reference[ticks][:-1], (position[ticks][1:] - offset) / run.static_gain
    model_output_um = _modelled_output(run, drive, rest_segment, segment)[: v.size]
    shape, model_shape = loop_shape(v, y), loop_shape(v, model_output_um)
    steady = slice(int(v.size * 0.5 / options.cycles), None)
    gain = float(v[steady] @ y[steady] / (v[steady] @ v[steady]))
    error, omega = v - y, y - gain * v
    error_um, model_error_um = float(np.abs(error).max()), float(np.abs(v - model_output_um).max())
    rows = [
        run.row("residual_percent", "h/H after compensation", "%", shape.percent, model_shape.percent, TOLERANCE),
        run.row("residual_um", "h after compensation", "µm", shape.height, model_shape.height, TOLERANCE),
        run.row("", "largest |v − y|", "µm", error_um, model_error_um, TOLERANCE),
        run.row("slope", "ρ, slope of y over v", "1", gain),
        run.row("omega_um", "largest |Ω| = |y − ρ v|", "µm", float(np.abs(omega).max())),
    ]
    notes = ["y is x/D(0), where D(0) is the static gain of [axis.model]; at this frequency the dynamics should have "
             "no other effect.",
             "The model is [axis.feedforward], driven with the recorded voltage. If the inverse of this "
             "model computed that voltage, only the dead band of the first threshold remains."]  # fmt: skip
    if run.simulated_hysteresis == "residual":
        notes.append("The simulated actuator (option hysteresis.truth = \"residual\" of the plant) was chosen to "
        "leave 3.75 % of hysteresis. A result of 3.75 % shows that rig, inverse and analysis agree. This result says "
        "nothing about a real stage.")  # fmt: skip
    return Analysis(rows, {"v_y_error": thin_signals(v, y, error)}, notes=notes)


def _modelled_output(run: RecordedRun, drive: Real, rest: Segment, segment: Segment) -> Real:
    """Return the displacement (n,) of the actuator in µm, by [axis.feedforward], relative to its mean in `rest`.

    The result begins with `segment` and ends with the recording; `drive` (ticks,), V, is of the whole recording. The
    model starts without memory: at `rest` for a run about 0, else at the start of the recording, because the way to
    another middle leaves a memory.
    """
    start = 0 if run.middle_um else rest.start_tick
    output_um = model_output(run.actuator_model, drive[start:])
    rest_um = output_um[rest.start_tick - start : rest.start_tick + rest.ticks - start].mean()
    return output_um[segment.start_tick - start :] - rest_um


def draw(figure: Figure, curves: CompensationCurves, ink: Palette) -> None:
    """Draw y over v, and the error v − y over v; `curves` come from `analyse`."""
    loop, error_panel = figure.subplots(1, 2)
    v, y, error = curves["v_y_error"]
    ends = np.array([v.min(), v.max()])
    loop.plot(ends, ends, color=ink.faint, linewidth=1.0, linestyle="--", label="y = v")
    loop.plot(v, y, color=ink.measured, label="measured")
    ink.label(loop, "command v / µm", "output y / µm", "output of the inverse compensation", legend="best")
    error_panel.axhline(0, color=ink.faint, linewidth=0.8)
    error_panel.plot(v, error, color=ink.error, linewidth=1.0)
    ink.label(error_panel, "command v / µm", "ε = v − y / µm", "error after compensation")


EXPERIMENT = Experiment(
    "compensation",
    "Inverse compensation alone",
    "Feedforward without feedback: the command is a slow sine. The inverse hysteresis model computes the "
    "drive from it.",
    CompensationOptions,
    runs,
    analyse,
    draw,
    limits={"amplitude_um": largest_command},
    needs_controller=False,
)
