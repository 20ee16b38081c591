"""A step of the whole drive without a controller, and the ringing that follows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple, TypedDict

import numpy as np
from pydantic import Field

from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.palette import Palette
from rtloop.experiments.largest_amplitudes import largest_part_of_drive
from rtloop.experiments.linear_model import LinearModel
from rtloop.experiments.procedure import Experiment
from rtloop.experiments.recorded_run import RecordedRun
from rtloop.experiments.setting import Setting
from rtloop.experiments.timeline import Run, hold
from rtloop.experiments.verdict import Analysis
from rtloop.foundation.arrays import Real
from rtloop.foundation.options import Options
from rtloop.hysteresis.plays import loading_curve

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN_S, SHOWN_PERIODS = 0.1, 9.0
RINGING_S = 0.015, 0.1
"""Window after the step in s: faster modes have mostly decayed by its start, and little ringing is left after it."""
MIN_PERIODS = 5
"""Least periods in the window; slower motion does not count as ringing."""
TOLERANCE_RATIO, DAMPING_TOLERANCE, FINAL_TOLERANCE = 0.002, 0.05, 0.01
"""Expected agreement with the model, as a fraction of its value."""


class StepResponseOptions(Options):
    """Options: height and duration of the step of the drive."""

    part_of_drive: float = Field(default=1.0, gt=0, le=1)
    """Height of the step, as a fraction of the drive limit."""
    duration_s: float = Field(default=0.5, ge=0.2)
    """Duration of the recording after the step, in which the ringing is fitted."""


class Ringing(NamedTuple):
    """Decaying sine about a level in µm: natural frequency √(σ² + ω²)/2π in Hz, and damping ratio."""

    frequency_hz: float
    damping: float
    level: float


class ModelResponse(NamedTuple):
    """Position (n,) of the model after the step, scaled to the measured final position, and its figures.

    `difference_percent` is the largest distance to the measured position, in % of the final one. All are None without a
    model; the ringing's also without a resonance.
    """

    response: Real | None
    overshoot_percent: float | None
    frequency_hz: float | None
    damping: float | None
    difference_percent: float | None


def runs(options: StepResponseOptions, setting: Setting) -> list[Run]:
    """Plan one run in mode raw: rest, then a step of the drive to `part_of_drive` times `limits.drive_v`."""
    timeline = setting.timeline("raw", uses_whole_drive=True)
    timeline.add("step", "raw", hold(options.part_of_drive * setting.axis.limits.drive_v), options.duration_s)
    return [Run("", timeline)]


class StepResponseCurves(TypedDict):
    """Position after the step in µm, measured and modelled, over the time in ms."""

    time_ms: Real
    measured: Real
    final: float
    model: Real | None
    zoom_ms: float


def analyse(recordings: Sequence[RecordedRun], options: StepResponseOptions) -> Analysis[StepResponseCurves]:
    """Evaluate overshoot, ringing (frequency and damping) and final position from one recording, beside the model's.

    The curves are the positions, measured and modelled, after the step. Raises UnsuitableData for too little ringing.
    """
    (run,) = recordings
    position = run.signal("position_um")
    rest_segment, step = run.segments_labelled("rest")[0], run.segments_labelled("step")[0]
    height = position[step.tick_slice] - position[rest_segment.tick_slice].mean()
    final = float(height[-height.size // 5 :].mean())
    time_s = np.arange(height.size) / run.rate_hz
    window = ringing_window(run.model)
    ringing = fit_ringing(height, run.rate_hz, window)
    overshoot = 100 * (float((height / final).max()) - 1)
    modelled = ModelResponse(None, None, None, None, None)
    if run.model is not None:
        model_response = run.model.open_response(np.ones(height.size)) * final / run.static_gain
        model_ringing = fit_ringing(model_response, run.rate_hz, window) if run.model.resonance_hz else None
        modelled = ModelResponse(
            model_response,
            100 * (float((model_response / final).max()) - 1),
            model_ringing and model_ringing.frequency_hz,
            model_ringing and model_ringing.damping,
            100 * float(np.abs(height - model_response).max()) / abs(final),
        )
    largest_v = options.part_of_drive * run.axis_options.limits.drive_v
    final_model = float(loading_curve(run.actuator_model, largest_v)) * run.static_gain if run.model else None
    rows = [
        run.row("open_overshoot_percent", "overshoot", "%", overshoot, modelled.overshoot_percent, 0.5),
        run.row("resonance_hz", "frequency of the ringing", "Hz", ringing.frequency_hz, modelled.frequency_hz,
                  TOLERANCE_RATIO * (modelled.frequency_hz or 0.0)),
        run.row("", "damping ratio of the ringing", "1", ringing.damping, modelled.damping,
                  DAMPING_TOLERANCE * (modelled.damping or 0.0)),
        run.row("", "final position", "µm", final, final_model, FINAL_TOLERANCE * abs(final_model or 0.0)),
    ]  # fmt: skip
    if modelled.difference_percent is not None:
        difference = modelled.difference_percent
        rows.append(run.row("open_fit", "largest difference to the model", "%", difference, 0.0, 0.5))
    notes = ["[axis.model] is missing: no model is compared with the measurement."]
    if run.model:
        notes = [
            "The model's response is scaled to the measured final position, because the hysteresis determines the "
            "height. The model is [axis.model] with the loop's zero-order hold."
        ]
    is_shown = time_s <= SHOWN_S
    curves: StepResponseCurves = {
        "time_ms": 1e3 * time_s[is_shown], "measured": height[is_shown], "final": final,
        "model": None if modelled.response is None else modelled.response[is_shown],
        "zoom_ms": 1e3 * SHOWN_PERIODS / ringing.frequency_hz,
    }  # fmt: skip
    return Analysis(rows, curves, notes=notes)


def ringing_window(model: LinearModel | None) -> tuple[float, float]:
    """Return begin and end, in s after a step, of the time in which the resonance rings alone and is visible.

    RINGING_S without a model or a resonance.
    """
    if model is None or not model.resonance_hz:
        return RINGING_S
    decay_s = 1 / max(model.decay_per_s, 1e-3)
    return min(RINGING_S[0], decay_s), min(RINGING_S[1], max(6 * decay_s, 10 / model.resonance_hz))


def fit_ringing(height: Real, rate_hz: float, window_s: tuple[float, float] = RINGING_S) -> Ringing:
    """Return the ringing of the position `height` (n,) since a step, in µm, within the window.

    Its frequency (Hz), damping ratio and level c come from the fit of c + Re(a e^{(−σ + jω)t}). Raises UnsuitableData
    for fewer than 50 ticks in the window, and for no ringing of MIN_PERIODS or more periods in it.
    """
    from scipy.optimize import least_squares  # a quarter of a second of import, for one experiment of many

    ringing = height[round(window_s[0] * rate_hz) : round(window_s[1] * rate_hz)]
    fault = UnsuitableData(
        f"no ringing found in {ringing.size} ticks, {1e3 * window_s[0]:.3g} to {1e3 * window_s[1]:.3g} ms after "
        f"the step; allowed: at least 50 ticks that contain {MIN_PERIODS} or more periods of ringing"
    )
    if ringing.size < 50:
        raise fault
    time_s = np.arange(ringing.size) / rate_hz
    spectrum = np.abs(np.fft.rfft((ringing - ringing.mean()) * np.hanning(ringing.size)))
    hz = np.fft.rfftfreq(ringing.size, 1 / rate_hz)
    spectrum[hz < MIN_PERIODS / (window_s[1] - window_s[0])] = 0.0
    if not spectrum.any():
        raise fault
    start = [20.0, 2 * np.pi * hz[spectrum.argmax()]]

    def residual(unknowns: Real) -> Real:
        """Return fit minus position (samples,) for (σ, ω), with the best c and a."""
        columns = _columns(unknowns, time_s)
        return columns @ np.linalg.lstsq(columns, ringing, rcond=None)[0] - ringing

    sigma, omega = least_squares(residual, start, x_scale=[10.0, 10.0], method="lm").x
    level = float(np.linalg.lstsq(_columns(np.array([sigma, omega]), time_s), ringing, rcond=None)[0][2])
    size = float(np.hypot(sigma, omega))
    return Ringing(size / (2 * np.pi), float(sigma) / size, level)


def _columns(unknowns: Real, time_s: Real) -> Real:
    """Return decaying cosine, decaying sine and 1 at `time_s` for (σ, ω), (samples, 3)."""
    sigma, omega = unknowns
    decay = np.exp(-sigma * time_s)
    return np.stack([decay * np.cos(omega * time_s), decay * np.sin(omega * time_s), np.ones_like(time_s)], axis=1)


def draw(figure: Figure, curves: StepResponseCurves, ink: Palette) -> None:
    """Draw the response, and enlarged its first milliseconds; `curves` come from `analyse`."""
    overview, zoom = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    for panel in (overview, zoom):
        panel.axhline(curves["final"], color=ink.faint, linewidth=0.8)
        panel.plot(
            curves["time_ms"], curves["measured"], color=ink.measured, linewidth=2.4, alpha=0.6, label="measured"
        )
        if curves["model"] is not None:
            panel.plot(curves["time_ms"], curves["model"], color=ink.model, linewidth=0.9, label="model")
    overview.set_xlim(0, 1e3 * SHOWN_S)
    zoom.set_xlim(0, curves["zoom_ms"])
    ink.label(overview, "time since the step / ms", "position x / µm", "a step of the drive", legend="lower right")
    ink.label(zoom, "time since the step / ms", "", "beginning of the response")


EXPERIMENT = Experiment(
    "step-response",
    "Open-loop step",
    "The drive makes one step to its limit, without any controller. The position answers with a damped ringing.",
    StepResponseOptions,
    runs,
    analyse,
    draw,
    limits={"part_of_drive": largest_part_of_drive},
    needs_controller=False,
)
