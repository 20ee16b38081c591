"""Loop and margins, from a small multisine in closed loop; `rtloop ctl response` measures them in a running loop.

With a stable loop of the model, the excitation is shaped so that the model's position moves equally at all frequencies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypedDict

import numpy as np
from pydantic import Field

from rtloop.analysis.margins import loop_margins
from rtloop.analysis.measured.excitation import REST_MARGIN, first_period, fit_period
from rtloop.analysis.measured.margins import UncertainValue
from rtloop.analysis.measured.measurement import SIGNALS, measure_loop
from rtloop.analysis.measured.mode import LARGEST_MISFIT, NOT_LINEAR
from rtloop.analysis.measured.multisine import HIGHEST_PART, LineGrid, make_grid
from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.palette import Palette
from rtloop.errors import ConfigError
from rtloop.experiments.largest_amplitudes import largest_swept_sine
from rtloop.experiments.procedure import Experiment
from rtloop.experiments.recorded_run import RecordedRun
from rtloop.experiments.setting import REST_S, Setting
from rtloop.experiments.timeline import Run, hold
from rtloop.experiments.verdict import Analysis, Row, Table
from rtloop.foundation.arrays import Complex, Real
from rtloop.foundation.options import Options

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DIGITS = 7
"""Decimals of the reference's levels."""
MARGIN_TOLERANCE, MODE_TOLERANCE, SIGMA_FACTOR = 0.02, 0.004, 3.0
"""Expected agreement of a margin, and of the resonance, with the model: a fraction of it, or
so many standard deviations."""
ROWS = (("crossover_hz", "crossover", "Hz"), ("gain_margin", "gain margin", "1"),
        ("phase_margin_deg", "phase margin", "°"), ("max_sensitivity", "largest |S|", "1"))  # fmt: skip


class ResponseOptions(Options):
    """Options of the multisine: motion of the position, band, period, number of measured periods."""

    amplitude_um: float = Field(default=0.5, gt=0)
    """Largest motion of the position that the model predicts for the multisine."""
    from_hz: float = Field(default=2.0, gt=0)
    """Lowest frequency of the multisine."""
    to_hz: float | None = Field(default=None, gt=0)
    """Highest frequency, 0.45 of the rate by default."""
    period_s: float = Field(default=1.0, gt=0, le=10)
    """Period of the multisine; its inverse is the distance of the frequencies."""
    periods: int = Field(default=5, ge=2)
    """Number of measured periods, after one in which the loop settles; more give smaller deviations."""


def runs(options: ResponseOptions, setting: Setting) -> list[Run]:
    """Plan one run in closed loop: a multisine of the reference, a settling period and the measured ones, then rest.

    Raises ConfigError for a band or period that `make_grid` refuses.
    """
    period = _reference_period(options, setting)
    timeline = setting.timeline("closed_loop")
    levels = {"kind": "steps", "levels": period.tolist(), "dwell_s": 1 / setting.rate_hz}
    timeline.add("multisine", "closed_loop", levels, (options.periods + 1) * options.period_s)
    timeline.add("rest", "closed_loop", hold(0.0), REST_S)
    return [Run("", timeline)]


def _reference_period(options: ResponseOptions, setting: Setting) -> Real:
    """Return one period of the reference in µm, (samples,), which begins at the sample nearest to 0.

    Raises ConfigError for a band or period that `make_grid` refuses.
    """
    lines = _line_grid(options, setting)
    model = setting.model
    tracking = None if model is None else model.tracking(lines.hz)
    if model is None or tracking is None:
        period = first_period(lines, options.amplitude_um)
    else:
        period = fit_period(lines, tracking, tracking / model.plant(lines.hz), options.amplitude_um)
    return np.round(np.roll(period, -int(np.argmin(np.abs(period)))), DIGITS)


def _line_grid(options: ResponseOptions, setting: Setting) -> LineGrid:
    """Return the frequencies of the multisine as a LineGrid, dense about the model's resonance.

    Raises ConfigError for a band or period that `make_grid` refuses.
    """
    to_hz = options.to_hz or HIGHEST_PART * setting.rate_hz
    near_hz = setting.model and setting.model.resonance_hz
    try:
        return make_grid(setting.rate_hz, options.period_s, options.from_hz, to_hz, near_hz)
    except ValueError as error:
        raise ConfigError("parameters of the experiments", [f"response: {error}"]) from None


class ResponseCurves(TypedDict):
    """The loop L at frequencies in Hz, its relative standard deviation, and the model's L."""

    hz: Real
    loop: Complex
    spread: Real
    model: Complex | None


def analyse(recordings: Sequence[RecordedRun], options: ResponseOptions) -> Analysis[ResponseCurves]:
    """Evaluate measured margins and resonance beside the model's, from one recording.

    The curves are the loop L at every line of the multisine, measured and modelled. Raises UnsuitableData if the
    position moved further than planned, ValueError if the signals allow no measurement.
    """
    (run,) = recordings
    near_hz, loop = (run.model.resonance_hz, run.model.loop) if run.model else (None, None)
    signals: dict[str, Real] = dict(zip(SIGNALS, run.read(*SIGNALS), strict=True))
    taps = run.axis_options.prefilter.command_taps
    measurement = measure_loop(signals, run.rate_hz, near_hz, loop, taps)
    allowed_um = options.amplitude_um + REST_MARGIN * _motion_at_rest_um(run, signals["position_um"])
    if (moved_um := measurement.response.moved_um) > allowed_um:
        raise UnsuitableData(
            f"the position moved by {moved_um:.3g} µm; allowed: {allowed_um:.3g} µm, the sum of amplitude_um = "
            f"{options.amplitude_um:g} µm and {REST_MARGIN:g} times the largest deviation of the position at rest. "
            "Use a smaller amplitude_um, or identify the model again"
        )
    promised_margins = loop_margins(loop)._asdict() if loop else {}
    rows = [
        _row(run, name, label, unit, getattr(measurement.margins, name), promised_margins.get(name))
        for name, label, unit in ROWS
    ]
    if measurement.mode is not None:
        rows.append(
            _row(
                run,
                "resonance_hz",
                "resonance",
                "Hz",
                UncertainValue(measurement.mode.hz, measurement.mode.hz_std),
                near_hz,
                MODE_TOLERANCE,
            )
        )
    deviations = [
        [label, f"{margin.value:.5g}", f"{margin.std:.2g}"]
        for name, label, _ in ROWS
        if math.isfinite((margin := getattr(measurement.margins, name)).value)
    ]
    notes = [f"The multisine moved the position by {moved_um:.3g} µm. The figures hold for motions of this size only."]
    if measurement.mode is not None and measurement.mode.misfit > LARGEST_MISFIT:
        notes.append(
            f"The residuals are {measurement.mode.misfit:.2g} times as large as the measurement's uncertainty "
            f"explains: {NOT_LINEAR}."
        )
    curves: ResponseCurves = {
        "hz": measurement.loop.hz, "loop": measurement.loop.loop, "spread": measurement.loop.spread,
        "model": None if loop is None else loop.open(measurement.loop.hz),
    }  # fmt: skip
    return Analysis(rows, curves, (Table("Standard deviations", ("margin", "measured", "± (1σ)"), deviations),), notes)


def _motion_at_rest_um(run: RecordedRun, position_um: Real) -> float:
    """Return the largest deviation of the position at rest from its mean, in µm, in the second half of the last rest.

    This rest follows the multisine. `position_um` (ticks,) has the whole run.
    """
    *_, segment = run.segments_labelled("rest")
    rest_um = position_um[segment.tail_slice(segment.ticks // 2)]
    return float(np.abs(rest_um - rest_um.mean()).max())


def _row(
    run: RecordedRun,
    name: str,
    label: str,
    unit: str,
    measured_value: UncertainValue,
    model: float | None,
    tolerance_ratio: float = MARGIN_TOLERANCE,
) -> Row:
    """Return the row of a measured value, with the `model`'s value (or None), and the specification's limit of `name`.

    The tolerance is SIGMA_FACTOR standard deviations, or `tolerance_ratio` of the model's value if that is larger.
    """
    tolerance = max(
        SIGMA_FACTOR * (measured_value.std if math.isfinite(measured_value.std) else 0.0),
        tolerance_ratio * abs(model or 0.0),
    )
    return run.row(name, label, unit, measured_value.value, model, tolerance)


def draw(figure: Figure, curves: ResponseCurves, ink: Palette) -> None:
    """Draw L in magnitude and phase, and |S|, each with the model's; `curves` come from `analyse`."""
    hz, loop, model = curves["hz"], curves["loop"], curves["model"]
    magnitude, phase, sensitivity = figure.subplots(3, 1, sharex=True)
    std = np.abs(loop) * curves["spread"]
    for panel, value, width in (
        (magnitude, np.abs(loop), std),
        (sensitivity, 1 / np.abs(1 + loop), std / np.abs(1 + loop) ** 2),
    ):
        panel.fill_between(hz, np.maximum(value - 2 * width, 1e-9), value + 2 * width, color=ink.measured, alpha=0.25)
        panel.loglog(hz, value, ".-", color=ink.measured, markersize=3, linewidth=0.8, label="measured, ±2σ")
    phase.semilogx(hz, np.degrees(np.unwrap(np.angle(loop))), ".-", color=ink.measured, markersize=3, linewidth=0.8)
    if model is not None:
        magnitude.loglog(hz, np.abs(model), color=ink.model, linewidth=0.8, label="model")
        phase.semilogx(hz, np.degrees(np.unwrap(np.angle(model))), color=ink.model, linewidth=0.8)
        sensitivity.loglog(hz, 1 / np.abs(1 + model), color=ink.model, linewidth=0.8)
    magnitude.set_ylim(bottom=0.3 * float(np.abs(loop).min()))
    ink.label(magnitude, "", "|L|", "loop gain L, measured in closed loop", legend="lower left")
    ink.label(phase, "", "phase of L / °")
    ink.label(sensitivity, "frequency / Hz", "|S|")


EXPERIMENT = Experiment(
    "response",
    "Loop and margins, measured",
    "A small multisine excites the loop with feedforward and feedback. Results: loop gain L, sensitivity S, and their "
    "margins with standard deviations.",
    ResponseOptions,
    runs,
    analyse,
    draw,
    limits={"amplitude_um": largest_swept_sine},
    size=(11.0, 8.0),
)
