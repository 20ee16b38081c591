"""A disturbance Ω added to the actuator's displacement, as a step and as sines: the remaining error in closed loop.

x = S D Ω in closed loop, so that the error at rest is −x
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from rtloop.design.palette import Palette
from rtloop.design.verification.judgement import Limit
from rtloop.experiments.lockin import tone
from rtloop.experiments.procedure import Experiment
from rtloop.experiments.recorded_run import RecordedRun
from rtloop.experiments.setting import Setting
from rtloop.experiments.timeline import Run, hold
from rtloop.experiments.verdict import Analysis, Row, Table
from rtloop.foundation.arrays import Real
from rtloop.foundation.options import Numbers, Options

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REST_S, STEP_S, SHOWN_S, SETTLE_S = 0.2, 1.0, 0.15, 0.5
MIN_DURATION_S = 0.5
PART_OF_REACH = 0.05
"""Size of Ω without a specification, over the largest command."""
TOLERANCE_RATIO, STATIC_TOLERANCE_NM = 0.1, 3.0
"""Expected agreement with the model: a fraction of its value, and nm at rest."""


class DisturbanceOptions(Options):
    """Size and frequencies of the disturbance Ω."""

    amplitude_um: float | None = Field(default=None, gt=0)
    """The largest disturbance of the axis's specification, by default."""
    frequencies_hz: Numbers = (1.0, 2.9, 10.0, 50.0)
    """Frequencies of the sines, with a recording for each."""


def runs(options: DisturbanceOptions, setting: Setting) -> list[Run]:
    """Plan a run in closed loop for the disturbance's step, and one for each of its sines.

    Each disturbance has a run to itself, because a rig's disturbance is fixed when the rig is built.
    """
    amplitude_um = options.amplitude_um or disturbance_um(setting)
    planned_runs = [_plan_run("step", {"step_um": amplitude_um}, STEP_S, setting, settle_s=0.0)]
    for hz in options.frequencies_hz:
        duration_s = np.ceil(max(MIN_DURATION_S * hz, 2.0)) / hz
        change = {"sine_um": amplitude_um, "sine_hz": hz}
        planned_runs.append(_plan_run(f"{hz:g} Hz", change, duration_s, setting, settle_s=SETTLE_S, frequency_hz=hz))
    return planned_runs


def _plan_run(
    label: str, change: dict[str, float], duration_s: float, setting: Setting, settle_s: float, **values: float
) -> Run:
    """Return a run with one disturbance: REST_S without it, `settle_s` with it, then `duration_s` that are measured.

    `change` are options of the rig's disturbance; `values` are stored with the segment for the analysis.
    """
    timeline = setting.timeline("closed_loop", REST_S)
    disturbance = {**change, "start_s": timeline.ticks / setting.rate_hz}
    measured_ticks = round(duration_s * setting.rate_hz)
    timeline.add("disturbed", "closed_loop", hold(0.0), settle_s + duration_s, measured_ticks=measured_ticks, **values)
    return Run(label, timeline, {"disturbance": disturbance})


def disturbance_um(setting: Setting) -> float:
    """Return the specification's largest Ω in µm; if it states none, PART_OF_REACH of the largest slow command."""
    limits = setting.specification.disturbance
    return limits.largest_um if limits else PART_OF_REACH * setting.reach_um


def analyse(recordings: Sequence[RecordedRun], options: DisturbanceOptions) -> Analysis:
    """Evaluate the remaining error of the step over time, and of each sine, with the specification's limits.

    `recordings` has one run for the step and one for each sine, in any order. The curves are the error over time and
    over frequency, measured and modelled.
    """
    rows: list[Row] = []
    table: list[list[str]] = []
    amplitude_um = options.amplitude_um or 0.0
    curves: dict[str, Any] = {"amplitude_um": amplitude_um, "sines": []}
    for run in recordings:
        position = run.signal("position_um")
        rest_segment, segment = run.segments_labelled("rest")[0], run.segments_labelled("disturbed")[0]
        measured_slice = segment.tail_slice(segment.values["measured_ticks"])
        if "frequency_hz" not in segment.values:
            error = position[segment.tick_slice] - position[rest_segment.tick_slice].mean()
            model = run.model.disturbance_response(np.full(error.size, amplitude_um)) if run.model else None
            rows += _step_rows(run, error, model, amplitude_um)
            shown_ticks = round(SHOWN_S * run.rate_hz)
            curves |= {"time_ms": 1e3 * np.arange(shown_ticks) / run.rate_hz, "step": error[:shown_ticks],
                       "model": None if model is None else model[:shown_ticks]}  # fmt: skip
            continue
        hz = segment.values["frequency_hz"]
        error_nm = 1e3 * abs(tone(position[measured_slice], hz, run.rate_hz).amplitude)
        rejection = run.model.rejection(hz) if run.model else None
        model_nm = None if rejection is None else 1e3 * amplitude_um * float(abs(rejection[0]))
        rows.append(_row(run, f"remaining error at {hz:g} Hz", error_nm, model_nm, TOLERANCE_RATIO * (model_nm or 0.0),
                         error_limit_um(run, hz, amplitude_um)))  # fmt: skip
        table.append([f"{hz:g}", f"{error_nm:.1f}", f"{error_nm / amplitude_um / 1e3:.5f}"])
        curves["sines"].append((hz, error_nm))
    curves |= _frequency_curves(recordings[0], amplitude_um)
    notes = ["The disturbance Ω (µm) is added to the displacement of the actuator, before the dynamics of the stage. "
             "The model is the sampled loop of [axis.controller] and [axis.model].",
             "The loop at rest moves within the dead band of the hysteresis, which the inverse does not correct: slow "
             "errors decay more slowly than in the linear model."]  # fmt: skip
    tables = (Table("Sines", ("f / Hz", "remaining amplitude / nm", "per Ω"), table),) if table else ()
    return Analysis(rows, curves, tables, notes)


def error_limit_um(run: RecordedRun, hz: float, amplitude_um: float) -> float | None:
    """Return the error in µm, proportional to `amplitude_um`, that the specification allows for an Ω of this frequency.

    None without a limit, and above the frequency up to which it applies.
    """
    limits = run.specification.disturbance
    if limits is None or (limits.up_to_hz is not None and hz > limits.up_to_hz):
        return None
    return limits.error_um * amplitude_um / limits.largest_um


def _row(
    run: RecordedRun,
    quantity: str,
    value: float,
    model: float | None,
    tolerance: float,
    limit_um: float | None,
    unit: str = "nm",
) -> Row:
    """Return the row of a remaining error in nm or, with `unit` "ms", of a duration; `value` and `model` are in `unit`.

    `limit_um` is the largest error that the specification allows, in µm, and becomes the row's limit in nm; None: no
    limit.
    """
    row = run.row("disturbance_left_nm" if unit == "nm" else "", quantity, unit, value, model, tolerance)
    return row if limit_um is None else replace(row, limit=Limit(1e3 * limit_um, at_most=True))


def _step_rows(run: RecordedRun, error: Real, model: Real | None, amplitude_um: float) -> list[Row]:
    """Return rows of largest error, settling time (only with a limit), and static error after a step, in nm and ms.

    `error` (n,) and the `model`'s error (None without a model) are in µm and begin with the step. A step contains all
    frequencies: a limit that holds up to some frequency judges the static error alone.
    """
    static_limit_um, peak_limit_um = (
        error_limit_um(run, 0.0, amplitude_um),
        error_limit_um(run, math.inf, amplitude_um),
    )
    rows = []
    for quantity, measure, tolerance_ratio, limit_um in (
        ("largest error after the step", _largest_nm, TOLERANCE_RATIO, peak_limit_um),
        ("static error after the step", _static_nm, 0.0, static_limit_um),
    ):
        model_nm = None if model is None else measure(model)
        tolerance = max(STATIC_TOLERANCE_NM, tolerance_ratio * (model_nm or 0.0))
        rows.append(_row(run, quantity, measure(error), model_nm, tolerance, limit_um))
    if static_limit_um is not None:
        settling_ms = [
            None if signal is None else _settling_ms(signal, static_limit_um, run.rate_hz) for signal in (error, model)
        ]
        quantity, tolerance_ratio = (
            f"error within {1e3 * static_limit_um:g} nm after",
            TOLERANCE_RATIO * (settling_ms[1] or 0.0),
        )
        rows.insert(1, _row(run, quantity, settling_ms[0] or 0.0, settling_ms[1], tolerance_ratio, None, "ms"))
    return rows


def _largest_nm(error: Real) -> float:
    """Largest magnitude of the error in nm; `error` (n,) in µm."""
    return 1e3 * float(np.abs(error).max())


def _static_nm(error: Real) -> float:
    """Magnitude of the mean error of the last fifth, in nm; `error` (n,) in µm."""
    return 1e3 * float(abs(error[-error.size // 5 :].mean()))


def _settling_ms(error: Real, limit_um: float, rate_hz: float) -> float:
    """Time in ms after which the error (n,), µm, stays within ±`limit_um`; its whole duration if it never does."""
    outside = np.flatnonzero(np.abs(error) > limit_um)
    return 1e3 * float(outside[-1] + 1) / rate_hz if outside.size else 0.0


def _frequency_curves(run: RecordedRun, amplitude_um: float) -> dict[str, object]:
    """Return model and limit over frequency, for the picture: arrays hz, model_nm (n,), numbers asked_nm, asked_hz.

    `model_nm` is None without a model, `asked_nm` without a limit, which applies up to `asked_hz`.
    """
    hz = np.geomspace(0.1, min(1000.0, 0.4 * run.rate_hz), 2000)
    rejection = run.model.rejection(hz) if run.model else None
    limit_um = error_limit_um(run, 0.0, amplitude_um)
    up_to_hz = run.specification.disturbance.up_to_hz if run.specification.disturbance else None
    return {
        "hz": hz,
        "model_nm": None if rejection is None else 1e3 * amplitude_um * np.abs(rejection),
        "asked_nm": None if limit_um is None else 1e3 * limit_um,
        "asked_hz": min(up_to_hz or hz[-1], hz[-1]),
    }


def draw(figure: Figure, curves: Mapping[str, Any], ink: Palette) -> None:
    """Draw the step's decay, and the error over frequency; `curves` come from `analyse`."""
    step_panel, frequency_panel = figure.subplots(1, 2, width_ratios=(3, 2))
    limit_nm = curves["asked_nm"]
    if limit_nm is not None:
        label, band_um = f"±{limit_nm:g} nm, as required", 1e-3 * limit_nm
        step_panel.axhspan(-band_um, band_um, color=ink.limit, alpha=0.25, linewidth=0, label=label)
        frequency_panel.plot([curves["hz"][0], curves["asked_hz"]], [limit_nm] * 2, color=ink.limit, linewidth=1.2,
                             linestyle="--", label=f"{limit_nm:g} nm, as required")  # fmt: skip
    if "step" in curves:
        step_panel.plot(curves["time_ms"], curves["step"], color=ink.measured, label="position x")
        if curves["model"] is not None:
            step_panel.plot(curves["time_ms"], curves["model"], color=ink.model, linewidth=0.9, label="model")
    if (comparison := curves.get("beside")) is not None and "step" in comparison:
        label = f"the same with {comparison['name']}"
        step_panel.plot(comparison["time_ms"], comparison["step"], color=ink.comparison, linewidth=0.9, label=label)
    step_panel.margins(x=0)
    ink.label(
        step_panel, "time since the step of Ω / ms", "x / µm", f"step of {curves['amplitude_um']:g} µm", legend="best"
    )
    frequency_panel.set_xscale("log")
    frequency_panel.set_yscale("log")
    if curves["model_nm"] is not None:
        frequency_panel.plot(curves["hz"], curves["model_nm"], color=ink.model, linewidth=0.9, label="model, S·P")
    if curves["sines"]:
        frequency_panel.plot(*zip(*curves["sines"], strict=True), "o", color=ink.measured, label="measured")
    if comparison is not None and comparison["sines"]:
        frequency_panel.plot(
            *zip(*comparison["sines"], strict=True), "o", color=ink.comparison, label=comparison["name"]
        )
    ink.label(
        frequency_panel,
        "frequency of Ω / Hz",
        "amplitude of x / nm",
        f"sines of {curves['amplitude_um']:g} µm",
        legend="best",
    )


EXPERIMENT = Experiment(
    "disturbance",
    "Rejection of the disturbance",
    "A disturbance Ω of the simulated rig acts on the closed loop at rest, as a step and as sines.",
    DisturbanceOptions,
    runs,
    analyse,
    draw,
    defaults={"amplitude_um": disturbance_um},
    needs_rig=True,
)
