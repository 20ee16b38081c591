"""Fig 12: stepped sines from 1 kHz down to 0.01 Hz, for the drive alone, with feedforward, in closed loop.

From high to low, whole cycles each: a frequency starts on the branch of the loop where the one before has ended, so
that the slow ones need no cycle to settle. The amplitude is part of the answer, since a small one does not leave the
dead band of the hysteresis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import Field

from hil.linear import Real
from hil.options import Numbers, Options
from rtloop.config import ModeName
from rtloop.experiments import paper
from rtloop.experiments.lockin import response
from rtloop.experiments.procedure import CLOSED_PEAK, Experiment, Run, Setting, hold, sine
from rtloop.experiments.taken import Taken
from rtloop.experiments.theme import Ink
from rtloop.experiments.verdict import Analysis, Row, Said, Table

MODES: tuple[ModeName, ...] = ("raw", "feedforward", "closed_loop")
INPUTS = {"raw": "drive_v", "feedforward": "command_um", "closed_loop": "reference_um"}
NAMES = {"raw": "drive alone", "feedforward": "feedforward", "closed_loop": "feedforward and feedback"}
LEAST_S, REST_S = 0.25, 0.1
LEAST_CYCLE = 0.1
"""A frequency of which less would pass in `settle_s` is measured from its first cycle on."""
LOW_HZ, BEYOND_HZ = 1.0, 300.0
LEAST_COHERENCE = 0.5
NEAR_HZ = (530.0, 660.0)
AMPLITUDE_UM = 2.0
"""More than that would swing in closed loop, at some hundred Hz, as far as the oscillation interlock of
deploy/paper.toml allows; it cannot know that the ringing is meant."""
WIDE = (0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 60.0, 80.0, 100.0, 120.0, 140.0, 170.0, 200.0, 250.0,
        300.0, 350.0, 400.0, 450.0, 500.0, 540.0, 560.0, 575.0, 650.0, 700.0, 800.0, 900.0, 1000.0)  # fmt: skip
NEAR_RESONANCE = (585.0, 590.0, 593.0, 595.0, 596.0, 598.0, 601.0, 606.0, 612.0, 620.0)


class HarmonicOptions(Options):
    """The excitation; with `drive alone` it is the drive that would move so far at the model's mean gain."""

    amplitude_um: float = Field(default=AMPLITUDE_UM, gt=0)
    frequencies_hz: Numbers = Field(default=tuple(sorted((*WIDE, *NEAR_RESONANCE))), min_length=1)
    settle_s: float = Field(default=0.3, ge=0)
    """Before each measurement; the resonance dies away by 27 1/s."""


def runs(options: HarmonicOptions, setting: Setting) -> list[Run]:
    """All three modes in one recording."""
    timeline = setting.timeline()
    for mode in MODES:
        timeline.add("rest", mode, hold(0.0), REST_S)
        amplitude = options.amplitude_um / (setting.um_per_v if mode == "raw" else 1.0)
        for hz in sorted(options.frequencies_hz, reverse=True):
            measured_s = math.ceil(max(LEAST_S * hz, 1.0)) / hz
            settle_s = math.ceil(options.settle_s * hz - LEAST_CYCLE) / hz
            timeline.add(
                "sine", mode, sine(amplitude, hz), settle_s + measured_s, frequency_hz=hz,
                measured_ticks=round(measured_s * setting.rate_hz), gain=setting.um_per_v if mode == "raw" else 1.0,
            )  # fmt: skip
    return [Run("", timeline)]


def analyse(recordings: Sequence[Taken], options: HarmonicOptions) -> Analysis:
    """Magnitude, phase and coherence of each mode over frequency."""
    (taken,) = recordings
    found = {mode: _sweep(taken, mode) for mode in MODES}
    raw, feedforward, closed = (found[mode] for mode in MODES)
    as_modelled = options.amplitude_um == AMPLITUDE_UM
    high = closed[closed[:, 0] >= BEYOND_HZ]
    peak = raw[raw[:, 1].argmax()] if raw[-1, 0] > BEYOND_HZ else np.full(4, np.nan)
    low = [_low(one) for one in (raw, feedforward)]
    rows = [
        Row("frequency of the peak without control", "Hz", peak[0], paper.SAID_RESONANCE, paper.PEAK_HZ, 2.0),
        Row("height of the peak over low frequencies", "dB", peak[1] - low[0], model=paper.PEAK_DB, tolerance=0.5),
        Row("drive alone at low frequencies", "dB", low[0], Said("decays, from hysteresis", (-np.inf, -0.5)),
            paper.RAW_DB if as_modelled else None, 0.2),
        Row("feedforward at low frequencies", "dB", low[1], model=paper.FEEDFORWARD_DB if as_modelled else None,
            tolerance=0.2),
        Row("closed loop at the lowest frequency", "dB", float(closed[0, 1]), Said("cancelled out", (-0.1, 0.1)),
            paper.CLOSED_DB, 0.02),
        Row("closed loop, −3 dB", "Hz", bandwidth(closed), model=paper.BANDWIDTH_HZ, tolerance=5.0),
        Row("closed loop, largest beyond 300 Hz", "dB", float(high[:, 1].max()) if len(high) else np.nan,
            paper.SAID_REMOVED, paper.HIGH_PEAK_DB, 0.5),
    ]  # fmt: skip
    table = [[f"{hz:g}", *(f"{value:.{digits}f}" for mode in MODES for value, digits in
              zip(found[mode][number, 1:], (3, 2, 4), strict=True))]
             for number, hz in enumerate(raw[:, 0])]  # fmt: skip
    headings = ("f / Hz", *(f"{name}: {what}" for name in ("drive", "feedforward", "closed") for what in
                            ("dB", "phase / °", "γ²")))  # fmt: skip
    notes = [
        f"Amplitude {options.amplitude_um:g} µm. Drive alone: position per volt, relative to {_gain(taken):.4g} "
        "µm/V, the model's mean gain over the whole drive. A small amplitude does not leave the dead band of the "
        "hysteresis: what drive and feedforward reach at low frequencies depends on it (by eq (4) −7.7 dB and −1.9 dB "
        "at 1 µm, −1.1 dB and 0.0 dB at 20 µm).",
        "In closed loop, beyond some hundred Hz, the command is smaller than the dead band, which takes more off than "
        "the linear model does.",
        "γ² is the part of the power of input and output that is at the excitation's frequency. Harmonics of the "
        "hysteresis lower it, most where one of them meets the resonance (120 Hz and 200 Hz), and so does noise: in "
        "closed loop the controller's notch leaves next to no command at 595 Hz. Points below 0.5 are not drawn.",
        "The models are D(s) of eq (5) held over each tick, and T(s) of eqs (5) and (20); D is shifted by the "
        "low-frequency magnitude of eq (4) at this amplitude where that is 2 µm.",
    ]
    shifts_db = (paper.RAW_DB, paper.FEEDFORWARD_DB) if as_modelled else ()
    curves = {"found": found, "shifts_db": shifts_db, "rate_hz": taken.rate_hz}
    return Analysis(rows, curves, (Table("Every frequency", headings, table),), notes)


def _sweep(taken: Taken, mode: str) -> Real:
    """Frequency, magnitude in dB, phase in °, coherence, by rising frequency, (frequencies, 4)."""
    u, x = taken.read(INPUTS[mode], "position_um")
    rows = []
    for segment in taken.labelled("sine"):
        if segment.mode == mode:
            part = taken.tail(segment, segment.values["measured_ticks"])
            hz = segment.values["frequency_hz"]
            gain, coherence = response(u[part], x[part], hz, taken.rate_hz)
            relative = gain / segment.values["gain"]
            rows.append((hz, 20 * np.log10(abs(relative)), np.degrees(np.angle(relative)), coherence))
    return np.array(rows)[::-1]


def _gain(taken: Taken) -> float:
    return next(one.values["gain"] for one in taken.labelled("sine"))


def _low(found: Real) -> float:
    """Median magnitude up to LOW_HZ, or the lowest there is."""
    inside = found[:, 0] <= max(LOW_HZ, found[0, 0])
    return float(np.median(found[inside, 1]))


def bandwidth(found: Real) -> float:
    """Where the magnitude first falls 3 dB below that of the lowest frequency, between points on a line; else NaN."""
    below = np.flatnonzero(found[:, 1] < found[0, 1] - 20 * np.log10(np.sqrt(2)))
    if not below.size:
        return np.nan
    i = below[0]
    return float(
        np.interp(-(found[0, 1] - 20 * np.log10(np.sqrt(2))), -found[i - 1 : i + 1, 1], found[i - 1 : i + 1, 0])
    )


def draw(figure: Any, curves: Mapping[str, Any], ink: Ink) -> None:
    """Magnitude, phase and coherence over frequency, and again near the resonance."""
    panels = figure.subplots(3, 2, sharex="col", sharey="row", height_ratios=(4, 2, 1.2), width_ratios=(3, 1.3))
    for column in panels.T:
        _draw_column(column, curves, ink)
    (magnitude, near), (phase, _), (coherence, near_coherence) = panels
    magnitude.set_xscale("log")
    near.set_xlim(*NEAR_HZ)
    magnitude.set_ylim(bottom=-30)
    coherence.set_ylim(-0.05, 1.1)
    ink.label(magnitude, "", "magnitude / dB", "Fig 12: harmonic response")
    ink.label(near, "", "", "near the resonance")
    ink.label(phase, "", "phase / °")
    ink.label(coherence, "frequency / Hz", "γ²")
    ink.label(near_coherence, "frequency / Hz", "")
    ink.legend(magnitude, loc="upper left")


def _draw_column(panels: Any, curves: Mapping[str, Any], ink: Ink) -> None:
    magnitude, phase, coherence = panels
    for mode, color in zip(MODES, (ink.error, ink.drive, ink.measured), strict=True):
        hz, decibels, degrees, part = curves["found"][mode].T
        trusted = np.where(part >= LEAST_COHERENCE, 1.0, np.nan)
        style = {"color": color, "markersize": 3, "linewidth": 0.9}
        magnitude.plot(hz, decibels * trusted, "o-", label=NAMES[mode], **style)
        phase.plot(hz, unwrapped(degrees, trusted), "o-", **style)
        coherence.plot(hz, part, "o-", **style)
    highest = max(found[-1, 0] for found in curves["found"].values())
    hz = np.union1d(np.geomspace(0.01, max(highest, 10.0), 2000), np.linspace(*NEAR_HZ, 500))
    held = 20 * np.log10(np.sinc(hz / curves["rate_hz"]))
    for number, shift_db in enumerate(curves["shifts_db"]):
        model = 20 * np.log10(np.abs(paper.dynamics(hz) / paper.dynamics(np.zeros(1)))) + shift_db + held
        label = "D(s) of eq (5), eq (4) at this amplitude" if number == 0 else None
        magnitude.plot(hz, model, color=ink.model, linewidth=0.8, linestyle="--", label=label)
    closed = 20 * np.log10(np.abs(1 - paper.sensitivity(hz)))
    magnitude.plot(hz, closed, color=ink.model, linewidth=0.8, label="T(s) of eqs (5) and (20)")
    magnitude.axvline(400.0, color=ink.paper, linewidth=1.0, linestyle=":", label="400 Hz, the paper's resonance")


def unwrapped(degrees: Real, trusted: Real) -> Real:
    """Phases of the trusted points (1, else NaN) without jumps of a turn."""
    found, kept = degrees * trusted, trusted == 1.0
    found[kept] = np.degrees(np.unwrap(np.radians(degrees[kept])))
    return found


EXPERIMENT = Experiment(
    "harmonic",
    "Harmonic response",
    "Fig 12",
    "Stepped sines from 0.01 Hz to 1 kHz: the drive alone, with feedforward, with feedforward and feedback.",
    HarmonicOptions,
    runs,
    analyse,
    draw,
    commanded={"amplitude_um": CLOSED_PEAK},
    size=(11.0, 8.0),
)
