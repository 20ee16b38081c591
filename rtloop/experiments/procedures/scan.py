"""Triangular scans whose tables of reference and command are learned from one recording to the next."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypedDict

import numpy as np
from pydantic import Field

from rtloop.analysis.learning import (
    MAX_ERROR_GROWTH,
    LearningGains,
    cycle_periods,
    learning_gains,
    rms,
    unlearned_table,
)
from rtloop.analysis.perturbation import plants_around
from rtloop.design.palette import Palette
from rtloop.errors import ConfigError
from rtloop.experiments.procedure import Experiment, UnsuitableLoop
from rtloop.experiments.recorded_run import RecordedRun
from rtloop.experiments.setting import Setting
from rtloop.experiments.timeline import Run
from rtloop.experiments.verdict import Analysis, Row, Table
from rtloop.foundation.arrays import Real
from rtloop.foundation.options import Numbers, Options

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class ScanOptions(Options):
    """Options of the triangular scans and their learning."""

    amplitude_um: float = Field(default=20.0, gt=0)
    """Half of peak to peak, in µm."""
    frequencies_hz: Numbers = Field(default=(10.0, 50.0, 100.0), min_length=1)
    """Frequencies of the scans; the period of each must be a whole number of ticks."""
    cycles: int = Field(default=5, ge=0, le=50)
    """Number of learning cycles, each a recording; one more recording precedes them."""
    resonance_percent: float = Field(default=2.0, ge=0, le=30)
    """Learning requires that the error shrinks with the resonance anywhere within so much of the model's."""


def triangle(period_ticks: int, amplitude_um: float) -> Real:
    """Return one period (period,) of a triangle in µm, from 0 upwards; `amplitude_um` is half of peak to peak."""
    turns = np.arange(period_ticks) / period_ticks
    return amplitude_um * (4 * np.abs((turns - 0.25) % 1 - 0.5) - 1)


def runs(options: ScanOptions, setting: Setting) -> list[Run]:
    """Plan the first run, in closed loop: unlearned triangles at each frequency in turn.

    Raises UnsuitableLoop without a model that has a stable loop of this axis alone, and if learning would not converge;
    ConfigError for a frequency whose period is not 4 or more whole ticks.
    """
    lengths = [_period_ticks(hz, setting.rate_hz) for hz in options.frequencies_hz]
    for ticks in lengths:
        _learning_gains(setting, options, ticks)
    return [
        _plan_run(0, options, setting, [unlearned_table(triangle(ticks, options.amplitude_um)) for ticks in lengths])
    ]


def plan_next_run(run_records: Sequence[RecordedRun], options: ScanOptions, setting: Setting) -> Run | None:
    """Plan the next run, with the tables learned from the recordings so far; None after the last.

    `run_records` begin with cycle 0, in the order of the cycles. At a frequency where the last rms error is above
    MAX_ERROR_GROWTH times the least, the table of the least error is played again. Raises UnsuitableLoop as `runs`.
    """
    if len(run_records) > options.cycles:
        return None
    tables = []
    for number in range(len(options.frequencies_hz)):
        errors = [_mean_error(run, number) for run in run_records]
        sizes = [rms(error) for error in errors]
        best_cycle = int(np.argmin(sizes))
        table = _recorded_table(run_records[best_cycle], number)
        if sizes[-1] <= MAX_ERROR_GROWTH * sizes[best_cycle]:
            table = _learning_gains(setting, options, len(table)).improve(
                _recorded_table(run_records[-1], number), errors[-1]
            )
        tables.append(table)
    return _plan_run(len(run_records), options, setting, tables)


def _plan_run(cycle: int, options: ScanOptions, setting: Setting, tables: Sequence[Real]) -> Run:
    """Return the run of one cycle that plays these tables (period, 2), one for each frequency.

    A table has the reference, about 0, to which the middle of the motion is added here, and the addition to the
    command, both in µm.
    """
    timeline, named_tables = setting.timeline("closed_loop"), {}
    for hz, table in zip(options.frequencies_hz, tables, strict=True):
        name, period_s = f"scan-{cycle}-{hz:g}Hz.npy", len(table) / setting.rate_hz
        settling_periods, measured_periods = cycle_periods(len(table), setting.rate_hz)
        named_tables[name] = table + np.array([timeline.middle.um, 0.0])
        duration_s = (settling_periods + measured_periods) * period_s
        timeline.add("scan", "closed_loop", {"kind": "table", "file": name}, duration_s,
                     frequency_hz=hz, period_ticks=len(table), periods=measured_periods)  # fmt: skip
    return Run(f"cycle {cycle}", timeline, tables=named_tables)


def _period_ticks(hz: float, rate_hz: float) -> int:
    """Return the period of `hz` in ticks. Raises ConfigError unless it is a whole number of ticks, 4 or more."""
    ticks = round(rate_hz / hz)
    if ticks < 4 or abs(rate_hz / ticks / hz - 1) > 1e-9:
        faults = [
            f"scan.frequencies_hz: {hz:g} Hz; allowed: frequencies with a period of 4 or more whole ticks, each of "
            f"{1 / rate_hz:g} s"
        ]
        raise ConfigError("parameters of the experiments", faults)
    return ticks


def _learning_gains(setting: Setting, options: ScanOptions, period_ticks: int) -> LearningGains:
    """Return the learning gains for one period, for the model and resonances around it.

    Raises UnsuitableLoop without a model, without a stable loop of this axis alone, and if learning would not converge.
    """
    model, percent = setting.model, options.resonance_percent
    if model is None or model.loop is None:
        raise UnsuitableLoop(
            f"axis.{setting.axis.name}: a scan learns with the model of a stable closed loop of this axis alone, but "
            "there is none. Possible causes: [axis.model] is missing, the loop is unstable, the controller cannot be "
            "linearised, or other axes share the controller"
        )
    loops = [(name, model.build_loop(plant)) for name, plant in plants_around(model.dynamics, percent)]
    try:
        return learning_gains([(name, loop) for name, loop in loops if loop is not None], period_ticks)
    except ValueError as error:
        raise UnsuitableLoop(f"axis.{setting.axis.name}.controller: {error}") from None


def _measured_slice(run: RecordedRun, number: int) -> tuple[slice, int]:
    """Return the evaluated ticks of scan `number`, from 0, and the number of ticks in its period.

    They are whole periods, at the end of the scan.
    """
    segment = run.segments_labelled("scan")[number]
    ticks = segment.values["period_ticks"]
    return segment.tail_slice(ticks * segment.values["periods"]), ticks


def _recorded_table(run: RecordedRun, number: int) -> Real:
    """Return the table (period, 2) that scan `number`, from 0, played: reference and addition to the command, µm."""
    measured_slice, ticks = _measured_slice(run, number)
    reference, feed = run.read("reference_um", "feed_um")
    return np.column_stack([reference[measured_slice][:ticks], feed[measured_slice][:ticks]])


def _mean_error(run: RecordedRun, number: int) -> Real:
    """Return the triangle minus the measured position of scan `number`, from 0, in µm: (period,).

    It is the mean of all evaluated periods.
    """
    measured_slice, ticks = _measured_slice(run, number)
    position = run.signal("position_um")[measured_slice].reshape(-1, ticks).mean(axis=0)
    return triangle(ticks, float(run.parameters["amplitude_um"])) - position


class ScanCurves(TypedDict):
    """Frequency in Hz, rms error of each cycle in %, first and last error in µm, for each scan."""

    traces: list[tuple[float, list[float], Real, Real]]


def analyse(recordings: Sequence[RecordedRun], options: ScanOptions) -> Analysis[ScanCurves]:
    """Evaluate the rms error of every frequency before and after learning, in % of peak to peak.

    `recordings` are in the order of the cycles. A table and the curves have the error of each cycle.
    """
    rows: list[Row] = []
    table, traces = [], []
    extent_um = 2 * options.amplitude_um
    for number, hz in enumerate(options.frequencies_hz):
        errors = [_mean_error(run, number) for run in recordings]
        percent = [100 * rms(error) / extent_um for error in errors]
        rows += [
            recordings[0].row("", f"rms error at {hz:g} Hz, {condition}", "%", percent[cycle_index])
            for condition, cycle_index in (("unlearned", 0), (f"after {len(errors) - 1} cycles", -1))
        ]
        table.append([f"{hz:g}", *(f"{value:.4f}" for value in percent), f"{1e3 * np.abs(errors[-1]).max():.1f}"])
        traces.append((hz, percent, errors[0], errors[-1]))
    headings = ("f / Hz", *(f"cycle {cycle}" for cycle in range(len(recordings))), "largest error, last cycle / nm")
    notes = ["Rms error of the mean of the evaluated periods, as a part of peak to peak. The mean removes noise, "
    "which is not an error of the scan."]  # fmt: skip
    return Analysis(rows, {"traces": traces}, (Table("Error from cycle to cycle, % of peak to peak", headings, table),),
                    notes)  # fmt: skip


def draw(figure: Figure, curves: ScanCurves, ink: Palette) -> None:
    """Draw the error over a period before and after learning, and the rms error over the cycles.

    `curves` come from `analyse`.
    """
    traces = curves["traces"]
    panels = figure.subplots(1, len(traces) + 1)
    for panel, (hz, _, first_error, last_error) in zip(panels, traces, strict=False):
        turns = np.arange(first_error.size) / first_error.size
        panel.plot(turns, first_error, color=ink.faint, label="unlearned")
        panel.plot(turns, last_error, color=ink.error, label="learned")
        panel.set_yscale("symlog", linthresh=max(1e-3, 2 * float(np.abs(last_error).max())))
        is_first = panel is panels[0]
        ink.label(panel, "period", "error / µm" if is_first else "", f"{hz:g} Hz", "best" if is_first else None)
    for (hz, percent, *_), colour in zip(traces, (ink.measured, ink.model, ink.error) * len(traces), strict=False):
        panels[-1].plot(percent, marker="o", markersize=3, color=colour, label=f"{hz:g} Hz")
    panels[-1].set_yscale("log")
    ink.label(panels[-1], "cycle", "rms error / % of peak to peak", "From cycle to cycle", legend="best")


EXPERIMENT = Experiment(
    "scan",
    "Scans that are learned",
    "Feedforward and feedback follow triangles. A table of the reference and an addition to the command is learned "
    "from cycle to cycle, to reduce the error.",
    ScanOptions,
    runs,
    analyse,
    draw,
    next_run=plan_next_run,
    limits={"amplitude_um": lambda setting: setting.reach},
    size=(13.0, 4.2),
)
