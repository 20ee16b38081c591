"""Fig 5: the whole drive at once, without any controller, and the ringing that follows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field
from scipy.optimize import least_squares

from hil.linear import Real
from hil.options import Options
from rtloop.design.measured import UnsuitableData
from rtloop.experiments import paper
from rtloop.experiments.procedure import Experiment, Run, Setting, hold
from rtloop.experiments.taken import Taken, whole
from rtloop.experiments.theme import Ink
from rtloop.experiments.verdict import Analysis, Row, Said

REST_S, SHOWN_S = 0.1, 0.1
RINGING_FROM_S, RINGING_UNTIL_S = 0.015, 0.1
"""By then the other modes of eq (5), the slowest at 463 1/s, have died away; later there is little left."""
LOWEST_HZ = 100.0


class StepResponseOptions(Options):
    """The step."""

    part_of_drive: float = Field(default=1.0, gt=0, le=1)
    """Of the drive limit."""
    duration_s: float = Field(default=0.5, ge=0.2)


class Ringing(NamedTuple):
    """A decaying sine about a level."""

    frequency_hz: float
    damping: float
    level: float


def runs(options: StepResponseOptions, setting: Setting) -> list[Run]:
    """Rest, then the step."""
    timeline = setting.timeline()
    timeline.add("rest", "raw", hold(0.0), REST_S)
    timeline.add("step", "raw", hold(options.part_of_drive * setting.axis.limits.drive_v), options.duration_s)
    return [Run("", timeline)]


def analyse(recordings: Sequence[Taken], options: StepResponseOptions) -> Analysis:
    """Overshoot of the final value, frequency and damping of the ringing."""
    (taken,) = recordings
    position = taken.signal("position_um")
    rest, step = taken.labelled("rest")[0], taken.labelled("step")[0]
    height = position[whole(step)] - position[whole(rest)].mean()
    final = float(height[-height.size // 5 :].mean())
    time_s = np.arange(height.size) / taken.rate_hz
    ringing = fitted_ringing(height, taken.rate_hz)
    overshoot = 100 * (float(height.max() / final) - 1)
    model = paper.open_step(time_s) * final / paper.dynamics(np.zeros(1)).real
    difference = 100 * float(np.abs(height - model).max()) / final
    at_limit = options.part_of_drive == 1.0
    rows = [
        Row("overshoot", "%", overshoot, paper.SAID_OVERSHOOT, paper.OVERSHOOT_PERCENT, 0.3),
        Row("frequency of the ringing", "Hz", ringing.frequency_hz, paper.SAID_RESONANCE, paper.RESONANCE_HZ, 1.0),
        Row("damping ratio of the ringing", "1", ringing.damping, model=paper.DAMPING, tolerance=0.0002),
        Row("final position", "µm", final, model=paper.FINAL_UM if at_limit else None, tolerance=0.3),
        Row("largest difference to D(s) of eq (5)", "%", difference, Said("D(s) can describe it"), 0.0, 0.3),
    ]
    notes = ["Eq (5) as printed rings at 595.5 Hz and overshoots by 14.47 %; eq (20) notches 595.5 Hz. The text's "
             "9.5 % and 400 Hz follow from no misprint of a single digit.",
             "D(s) is scaled to the final position: the height is the matter of the hysteresis."]  # fmt: skip
    shown = time_s <= SHOWN_S
    curves = {"time_ms": 1e3 * time_s[shown], "measured": height[shown], "model": model[shown], "final": final}
    return Analysis(rows, curves, notes=notes)


def fitted_ringing(height: Real, rate_hz: float) -> Ringing:
    """c + Re(a e^{(−σ + jω)t}) fitted to a step's answer from RINGING_FROM_S on. Raises UnsuitableData."""
    part = height[round(RINGING_FROM_S * rate_hz) : round(RINGING_UNTIL_S * rate_hz)]
    time_s = np.arange(part.size) / rate_hz
    spectrum = np.abs(np.fft.rfft((part - part.mean()) * np.hanning(part.size)))
    hz = np.fft.rfftfreq(part.size, 1 / rate_hz)
    spectrum[hz < LOWEST_HZ] = 0.0
    if part.size < 50 or not spectrum.any():
        raise UnsuitableData(f"step: {part.size} ticks of ringing; a rate of at least 1 kHz is needed")
    start = [20.0, 2 * np.pi * hz[spectrum.argmax()]]

    def residual(unknowns: Real) -> Real:
        columns = _columns(unknowns, time_s)
        return columns @ np.linalg.lstsq(columns, part, rcond=None)[0] - part

    sigma, omega = least_squares(residual, start, x_scale=[10.0, 10.0], method="lm").x
    level = float(np.linalg.lstsq(_columns(np.array([sigma, omega]), time_s), part, rcond=None)[0][2])
    size = float(np.hypot(sigma, omega))
    return Ringing(size / (2 * np.pi), float(sigma) / size, level)


def _columns(unknowns: Real, time_s: Real) -> Real:
    sigma, omega = unknowns
    decay = np.exp(-sigma * time_s)
    return np.stack([decay * np.cos(omega * time_s), decay * np.sin(omega * time_s), np.ones_like(time_s)], axis=1)


def draw(figure: Any, curves: Mapping[str, Any], ink: Ink) -> None:
    """The whole answer, and its first milliseconds."""
    overview, zoom = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    for panel in (overview, zoom):
        panel.axhline(curves["final"], color=ink.faint, linewidth=0.8)
        panel.plot(
            curves["time_ms"], curves["measured"], color=ink.measured, linewidth=2.4, alpha=0.6, label="measured"
        )
        panel.plot(curves["time_ms"], curves["model"], color=ink.model, linewidth=0.9, label="D(s) of eq (5)")
    overview.set_xlim(0, 1e3 * SHOWN_S)
    zoom.set_xlim(0, 15)
    ink.label(overview, "time since the step / ms", "position x / µm", "Fig 5: the whole drive at once")
    ink.label(zoom, "time since the step / ms", "", "the first 15 ms")
    ink.legend(overview, loc="lower right")


EXPERIMENT = Experiment(
    "step-response",
    "Open-loop step",
    "Fig 5",
    "The whole drive at once, without any controller: a damped ringing.",
    StepResponseOptions,
    runs,
    analyse,
    draw,
    both_ways=False,
    needs_controller=False,
)
