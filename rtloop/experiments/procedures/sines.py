"""Tracking of sines at several frequencies in closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypedDict

import numpy as np
from pydantic import Field

from rtloop.design.palette import Palette
from rtloop.experiments.largest_amplitudes import largest_sine
from rtloop.experiments.lockin import response
from rtloop.experiments.procedure import Experiment
from rtloop.experiments.recorded_run import RecordedRun
from rtloop.experiments.setting import Setting
from rtloop.experiments.timeline import Run, sine
from rtloop.experiments.verdict import Analysis, Table
from rtloop.foundation.arrays import Real
from rtloop.foundation.options import Numbers, Options

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MIN_DURATION_S = 0.5
TOLERANCE_RATIO, MIN_TOLERANCE_RATIO = 0.1, 0.0025
"""Expected agreement of an rms error with the model: a fraction of it, and at least one of the amplitude."""
SHOWN_CYCLES, POINTS = 2.0, 2000


class SinesOptions(Options):
    """Options: amplitude and frequencies of the reference, and the number of cycles."""

    amplitude_um: float = Field(default=20.0, gt=0)
    """Amplitude of the reference, reduced by default to fit limits and interlocks."""
    frequencies_hz: Numbers = Field(default=(0.1, 1.0, 5.0, 10.0, 20.0, 50.0), min_length=1)
    """Frequencies of the reference, one after the other."""
    cycles: int = Field(default=2, ge=1)
    """Evaluated cycles of each frequency, after one to settle; more where they are short."""


def runs(options: SinesOptions, setting: Setting) -> list[Run]:
    """Plan one run in closed loop: a sine at each frequency in turn, in whole cycles.

    The first cycle of each sine is for settling and is not evaluated.
    """
    timeline = setting.timeline("closed_loop")
    for hz in options.frequencies_hz:
        cycles = max(options.cycles, round(MIN_DURATION_S * hz))
        reference = sine(options.amplitude_um, hz)
        timeline.add("sine", "closed_loop", reference, (cycles + 1) / hz, frequency_hz=hz, cycles=cycles)
    return [Run("", timeline)]


class SinesCurves(TypedDict):
    """Frequency in Hz, cycles, reference and position in µm of each sine."""

    traces: list[tuple[float, Real, Real, Real]]


def analyse(recordings: Sequence[RecordedRun], options: SinesOptions) -> Analysis[SinesCurves]:
    """Evaluate rms error and phase at each frequency beside the model's, from one recording.

    A table also has the largest error, the gain and the coherence; the curves are the first two evaluated cycles of
    each frequency.
    """
    (run,) = recordings
    reference, position = run.read("reference_um", "position_um")
    rows, table, traces = [], [], []
    for segment in run.segments_labelled("sine"):
        hz = segment.values["frequency_hz"]
        measured_slice = segment.tail_slice(round(segment.values["cycles"] / hz * run.rate_hz))
        setpoint, measured = reference[measured_slice], position[measured_slice]
        error = setpoint - measured
        rms = float(np.sqrt(np.mean(error**2)))
        gain = response(setpoint, measured, hz, run.rate_hz)
        phase = float(np.degrees(np.angle(gain.gain)))
        model = run.model.tracking(hz) if run.model else None
        model_rms = None if model is None else options.amplitude_um * abs(1 - model[0]) / np.sqrt(2)
        model_phase = None if model is None else float(np.degrees(np.angle(model[0])))
        rows += [
            run.row("tracking", f"rms error at {hz:g} Hz", "µm", rms, model_rms,
                      max(MIN_TOLERANCE_RATIO * options.amplitude_um, TOLERANCE_RATIO * (model_rms or 0.0))),
            run.row("", f"phase at {hz:g} Hz", "°", phase, model_phase, max(0.3, 0.05 * abs(model_phase or 0.0))),
        ]  # fmt: skip
        table.append([f"{hz:g}", f"{rms:.4f}", f"{np.abs(error).max():.4f}", f"{abs(gain.gain):.5f}",
                      f"{20 * np.log10(abs(gain.gain)):.3f}", f"{phase:.3f}", f"{gain.coherence:.6f}"])  # fmt: skip
        step = max(1, setpoint.size // POINTS)
        cycles = hz * np.arange(setpoint.size)[::step] / run.rate_hz
        is_shown = cycles <= SHOWN_CYCLES
        traces.append((hz, cycles[is_shown], setpoint[::step][is_shown], measured[::step][is_shown]))
    headings = ("f / Hz", "rms error / µm", "largest error / µm", "|x/x_d|", "dB", "phase / °", "coherence")
    notes = ["The model is the sampled loop of [axis.controller] and [axis.model], without hysteresis. The "
             "hysteresis adds to the error at low frequencies."]  # fmt: skip
    return Analysis(rows, {"traces": traces}, (Table("Every frequency", headings, table),), notes)


def draw(figure: Figure, curves: SinesCurves, ink: Palette) -> None:
    """Draw the first two cycles of each frequency with the error below; `curves` come from `analyse`."""
    traces = curves["traces"]
    columns = min(3, len(traces))
    rows = -(-len(traces) // columns)
    grid = figure.add_gridspec(2 * rows, columns, height_ratios=(2, 1) * rows)
    for number, (hz, cycles, setpoint, measured) in enumerate(traces):
        row, column = divmod(number, columns)
        signal_panel, error_panel = (
            figure.add_subplot(grid[2 * row, column]),
            figure.add_subplot(grid[2 * row + 1, column]),
        )
        signal_panel.plot(cycles, measured, color=ink.measured, linewidth=2.4, alpha=0.6, label="position x")
        signal_panel.plot(cycles, setpoint, color=ink.model, linewidth=0.9, label="reference")
        error_panel.plot(cycles, setpoint - measured, color=ink.error, linewidth=0.9, label="error")
        signal_panel.tick_params(labelbottom=False)
        for panel in (signal_panel, error_panel):
            panel.set_xlim(0, SHOWN_CYCLES)
            panel.set_xticks(np.arange(0, SHOWN_CYCLES + 0.1, 0.5))
        ink.label(signal_panel, "", "x / µm" if column == 0 else "", f"{hz:g} Hz")
        ink.label(error_panel, "cycles" if row == rows - 1 else "", "e / µm" if column == 0 else "")
        if number == 0:
            handles = [line for panel in (signal_panel, error_panel) for line in panel.get_lines()]
            figure.legend(handles=handles, loc="outside upper right", ncols=3, fontsize=8, frameon=False)


EXPERIMENT = Experiment(
    "sines",
    "Closed-loop tracking of sines",
    "Feedforward and feedback: sines at several frequencies.",
    SinesOptions,
    runs,
    analyse,
    draw,
    limits={"amplitude_um": largest_sine},
    size=(11.0, 6.4),
)
