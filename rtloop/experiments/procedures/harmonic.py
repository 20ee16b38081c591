"""Stepped sines from high frequencies down to 0.01 Hz, for the drive alone, with feedforward, in closed loop.

The frequencies fall, with whole cycles of each: a sine starts on the branch of the hysteresis loop on which the sine
before it has ended, so that slow sines need no cycle to settle. The amplitude is part of the answer, since a small one
does not leave the dead band of the hysteresis.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypedDict

import numpy as np
import numpy.typing as npt
from pydantic import Field

from rtloop.configuration.schedule import ModeName
from rtloop.design.palette import Palette
from rtloop.design.synthesis.specification import ClaimOptions
from rtloop.experiments.largest_amplitudes import largest_swept_sine
from rtloop.experiments.lockin import response, tone
from rtloop.experiments.procedure import Experiment
from rtloop.experiments.procedures.harmonic_promise import REFERENCE_HZ, Curve, HarmonicPromise
from rtloop.experiments.recorded_run import RecordedRun
from rtloop.experiments.setting import REST_S, Setting
from rtloop.experiments.timeline import Run, hold, sine
from rtloop.experiments.verdict import Analysis, Table
from rtloop.foundation.arrays import Real
from rtloop.foundation.options import Numbers, Options
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import model_output
from rtloop.laws.shipped.options import PrandtlIshlinskiiOptions

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MODES: tuple[ModeName, ...] = ("raw", "feedforward", "closed_loop")
INPUTS = {"raw": "drive_v", "feedforward": "command_um", "closed_loop": "reference_um"}
NAMES = {"raw": "drive alone", "feedforward": "feedforward", "closed_loop": "feedforward and feedback"}
MIN_DURATION_S = 0.25
MIN_CYCLES = 0.1
"""A frequency with less of a cycle in `settle_s` is measured from its first cycle on."""
LOW_HZ, HIGH_RATIO = 1.0, 0.5
MIN_COHERENCE = 0.5
CYCLE_TICKS = 2000
BANDWIDTH_TOLERANCE, PEAK_TOLERANCE, LOW_TOLERANCE_DB = 0.04, 0.004, 0.2
"""Expected agreement with the model: fractions of bandwidth and resonance, dB of the loss by hysteresis."""
AMPLITUDE_UM = 2.0
"""Default amplitude; smaller where it would trip the oscillation interlock, which cannot know that it is intended."""
SLOW_HZ = (0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 60.0, 80.0, 100.0, 120.0, 140.0, 170.0, 200.0)
FAST_HZ = (250.0, 300.0, 350.0, 400.0, 450.0, 500.0, 540.0, 560.0, 575.0, 585.0, 590.0, 593.0, 595.0, 596.0, 598.0,
           601.0, 606.0, 612.0, 620.0, 650.0, 700.0, 800.0, 900.0, 1000.0)  # fmt: skip
"""Frequencies for a resonance at REFERENCE_HZ; scaled with the resonance."""
MAX_RATE_RATIO = 0.4
"""Highest frequency over the rate."""


def default_frequencies(setting: Setting) -> tuple[float, ...]:
    """Return frequencies in Hz, rising, from 0.01 Hz to beyond the resonance of the axis's model, dense about it.

    Without a resonance they are those for REFERENCE_HZ; those above MAX_RATE_RATIO of the rate are left out.
    """
    resonance_hz = setting.model and setting.model.resonance_hz
    scale = (resonance_hz or REFERENCE_HZ) / REFERENCE_HZ
    fast_hz = FAST_HZ if abs(scale - 1) < 0.001 else [float(f"{scale * hz:.4g}") for hz in FAST_HZ]
    return tuple(sorted({hz for hz in (*SLOW_HZ, *fast_hz) if hz <= MAX_RATE_RATIO * setting.rate_hz}))


class HarmonicOptions(Options):
    """Options of the excitation. The drive alone has the amplitude in V that moves the stage by `amplitude_um` at the
    mean gain of the hysteresis model.
    """

    amplitude_um: float = Field(default=AMPLITUDE_UM, gt=0)
    """Amplitude of reference and command, reduced by default to fit limits and interlocks."""
    frequencies_hz: Numbers | None = Field(default=None, min_length=1)
    """Frequencies up to beyond the resonance of the axis's model, dense about it, by default."""
    settle_s: float = Field(default=0.3, ge=0)
    """Least settling time before each measurement, in whole cycles."""


def runs(options: HarmonicOptions, setting: Setting) -> list[Run]:
    """Plan one run: raw, feedforward, closed loop in turn, each a rest and then sines from high to low frequencies."""
    timeline = setting.timeline()
    for mode in MODES:
        timeline.add("rest", mode, hold(0.0), REST_S)
        amplitude = options.amplitude_um / (setting.um_per_v if mode == "raw" else 1.0)
        for hz in sorted(options.frequencies_hz or default_frequencies(setting), reverse=True):
            measured_s = math.ceil(max(MIN_DURATION_S * hz, 1.0)) / hz
            settle_s = math.ceil(options.settle_s * hz - MIN_CYCLES) / hz
            timeline.add(
                "sine", mode, sine(amplitude, hz), settle_s + measured_s, frequency_hz=hz,
                measured_ticks=round(measured_s * setting.rate_hz), gain=setting.um_per_v if mode == "raw" else 1.0,
            )  # fmt: skip
    return [Run("", timeline)]


class HarmonicCurves(TypedDict):
    """Sweeps by mode, the band near the resonance in Hz, the model's curves and the claim."""

    measured: dict[str, Real]
    near_hz: tuple[float, float]
    modelled: list[Curve]
    claimed: ClaimOptions | None


def analyse(recordings: Sequence[RecordedRun], options: HarmonicOptions) -> Analysis[HarmonicCurves]:
    """Evaluate magnitude, phase and coherence of each mode over frequency, beside the model's, from one recording.

    Rows: peak without control, gain at low frequencies, bandwidth of the closed loop, and its largest response from
    half the resonance's frequency on.
    """
    (run,) = recordings
    sweeps = {mode: _sweep(run, mode) for mode in MODES}
    raw, feedforward, closed = (sweeps[mode] for mode in MODES)
    model = HarmonicPromise(run.model, raw[:, 0], run.rate_hz)
    peak = raw[raw[:, 1].argmax()] if raw[-1, 0] > model.resonance_hz else np.full(4, np.nan)
    beyond_hz = HIGH_RATIO * model.resonance_hz
    high_rows = closed[closed[:, 0] >= beyond_hz]
    low_db = [_low_frequency_db(sweep) for sweep in (raw, feedforward)]
    shifts_db = _model_hysteresis_db(run, options.amplitude_um)
    rows = [
        run.row("resonance_hz", "frequency of the peak without control", "Hz", peak[0], model.peak_hz,
                  max(PEAK_TOLERANCE * (model.peak_hz or 0.0), _spacing(raw[:, 0], peak[0]))),
        run.row("", "height of the peak over low frequencies", "dB", peak[1] - low_db[0], model.peak_db, 0.5),
        run.row("open_low_db", "gain of the drive alone, low frequencies", "dB", low_db[0], shifts_db[0],
                  LOW_TOLERANCE_DB),
        run.row("", "gain with feedforward, low frequencies", "dB", low_db[1], shifts_db[1], LOW_TOLERANCE_DB),
        run.row("closed_low_db", "closed loop at the lowest frequency", "dB", float(closed[0, 1]),
                  model.closed_low_db, 0.02),
        run.row("", "closed loop, −3 dB", "Hz", bandwidth_hz(closed), model.bandwidth_hz,
                  BANDWIDTH_TOLERANCE * (model.bandwidth_hz or 0.0)),
        run.row("closed_high_db", f"closed loop, largest beyond {beyond_hz:.3g} Hz", "dB",
                  float(high_rows[:, 1].max()) if len(high_rows) else np.nan, model.closed_db_beyond(beyond_hz), 0.5),
    ]  # fmt: skip
    table = [[f"{hz:g}", *(f"{value:.{digits}f}" for mode in MODES for value, digits in
              zip(sweeps[mode][number, 1:], (3, 2, 4), strict=True))]
             for number, hz in enumerate(raw[:, 0])]  # fmt: skip
    headings = ("f / Hz", *(f"{name}: {column}" for name in ("drive", "feedforward", "closed") for column in
                            ("dB", "phase / °", "γ²")))  # fmt: skip
    notes = [
        f"The amplitude is {options.amplitude_um:g} µm. The drive alone is shown as position per volt, relative to "
        f"{_raw_gain(run):.4g} µm/V, the model's mean gain over the whole drive. A small amplitude does not leave the "
        "dead band of the hysteresis. Therefore the gains of drive and feedforward at low frequencies depend on the "
        "amplitude. The model's values of these gains are those of [axis.feedforward] at this amplitude.",
        "In closed loop, at high frequencies, the command is smaller than the dead band of the hysteresis. The dead "
        "band makes the motion smaller than in the linear model.",
        "γ² is the part of the power of input and output that is at the excitation's frequency. Harmonics of the "
        "hysteresis lower γ², most where one of them meets the resonance. Noise lowers γ² where the controller's notch "
        f"leaves a very small command. Points below {MIN_COHERENCE:g} are not drawn.",
        "The dashed model curves are [axis.model] with its input held over each tick, shifted by the gain of the "
        "hysteresis at this amplitude. The solid model curve is the sampled loop of [axis.controller] and "
        "[axis.model].",
    ]
    curves: HarmonicCurves = {
        "measured": sweeps, "near_hz": model.near_hz, "modelled": model.curves(shifts_db),
        "claimed": run.specification.claims.get("resonance_hz"),
    }  # fmt: skip
    return Analysis(rows, curves, (Table("Every frequency", headings, table),), notes)


def _model_hysteresis_db(run: RecordedRun, amplitude_um: float) -> tuple[float | None, float | None]:
    """Return the model's gain in dB at this amplitude, of the drive alone and with feedforward.

    Both contain the static gain of the dynamics. Both are None without [axis.model], without Prandtl-Ishlinskii
    feedforward, and unless the feedforward's `dead_band` is "none".
    """
    feedforward = run.axis_options.feedforward
    if not isinstance(feedforward, PrandtlIshlinskiiOptions) or run.model is None or feedforward.dead_band != "none":
        return None, None
    gain_db = 20 * math.log10(abs(run.static_gain))
    raw_db, inverse_db = hysteresis_db(run.actuator_model, feedforward.models()[1], _raw_gain(run), amplitude_um)
    return raw_db + gain_db, inverse_db + gain_db


def hysteresis_db(actuator: PlayModel, inverse: PlayModel, um_per_v: float, amplitude_um: float) -> tuple[float, float]:
    """Return the fundamental of the position divided by `amplitude_um`, in dB, for two sines: of drive and command.

    The drive, of `amplitude_um` / `um_per_v` volts, acts on `actuator` alone; the command, of `amplitude_um`, on
    `inverse` and then on `actuator`.
    """
    command = amplitude_um * np.sin(2 * np.pi * np.arange(3 * CYCLE_TICKS) / CYCLE_TICKS)
    drives = command / um_per_v, model_output(inverse, command)
    positions = [model_output(actuator, drive)[-CYCLE_TICKS:] for drive in drives]
    raw_ratio, inverse_ratio = (
        abs(tone(position, 1.0, CYCLE_TICKS).amplitude) / amplitude_um for position in positions
    )
    return _db(raw_ratio), _db(inverse_ratio)


def _db(ratio: float) -> float:
    """Return a ratio in dB; −inf for 0 and below."""
    return 20 * math.log10(ratio) if ratio > 0 else -math.inf


def _sweep(run: RecordedRun, mode: str) -> Real:
    """Return frequency in Hz, magnitude in dB, phase in °, coherence, by rising frequency, (frequencies, 4).

    The magnitude is position over input of `mode`, divided by the `gain` stored with the segment.
    """
    u, x = run.read(INPUTS[mode], "position_um")
    rows = []
    for segment in run.segments_labelled("sine"):
        if segment.mode == mode:
            measured_slice = segment.tail_slice(segment.values["measured_ticks"])
            hz = segment.values["frequency_hz"]
            gain, coherence = response(u[measured_slice], x[measured_slice], hz, run.rate_hz)
            relative_gain = gain / segment.values["gain"]
            rows.append((hz, 20 * np.log10(abs(relative_gain)), np.degrees(np.angle(relative_gain)), coherence))
    return np.array(rows)[::-1]


def _raw_gain(run: RecordedRun) -> float:
    """Gain in µm/V by which the drive's responses are divided, as stored with the first sine of the recording."""
    return next(segment.values["gain"] for segment in run.segments_labelled("sine"))


def _low_frequency_db(sweep: Real) -> float:
    """Return the median magnitude in dB up to LOW_HZ, or at the lowest frequency if that is above.

    Rows of `sweep` (frequencies, 4): frequency in Hz, rising; magnitude in dB; phase in °; coherence.
    """
    is_low = sweep[:, 0] <= max(LOW_HZ, sweep[0, 0])
    return float(np.median(sweep[is_low, 1]))


def _spacing(hz: Real, at_hz: float) -> float:
    """Distance in Hz from the measured frequency `at_hz` to the second nearest other one; 0 for NaN."""
    if not np.isfinite(at_hz):
        return 0.0
    distances = np.sort(np.abs(hz - at_hz))[:3]
    return float(distances[-1])


def bandwidth_hz(sweep: Real) -> float:
    """Frequency in Hz at which the magnitude first falls 3 dB below the magnitude at the lowest frequency.

    Interpolated between measured points of a sweep (frequencies, 4); NaN if it does not fall so far.
    """
    attenuated = np.flatnonzero(sweep[:, 1] < sweep[0, 1] - 20 * np.log10(np.sqrt(2)))
    if not attenuated.size:
        return np.nan
    i = attenuated[0]
    return float(
        np.interp(-(sweep[0, 1] - 20 * np.log10(np.sqrt(2))), -sweep[i - 1 : i + 1, 1], sweep[i - 1 : i + 1, 0])
    )


def draw(figure: Figure, curves: HarmonicCurves, ink: Palette) -> None:
    """Draw magnitude, phase and coherence over frequency, and again near the resonance.

    `curves` come from `analyse`.
    """
    panels = figure.subplots(3, 2, sharex="col", sharey="row", height_ratios=(4, 2, 1.2), width_ratios=(3, 1.3))
    for column in panels.T:
        _draw_column(column, curves, ink)
    (magnitude, near), (phase, _), (coherence, near_coherence) = panels
    magnitude.set_xscale("log")
    near.set_xlim(*curves["near_hz"])
    magnitude.set_ylim(bottom=-30)
    coherence.set_ylim(-0.05, 1.1)
    ink.label(magnitude, "", "magnitude / dB", "harmonic response", legend="upper left")
    ink.label(near, "", "", "near the resonance")
    ink.label(phase, "", "phase / °")
    ink.label(coherence, "frequency / Hz", "γ²")
    ink.label(near_coherence, "frequency / Hz", "")


def _draw_column(panels: npt.NDArray[np.object_], curves: HarmonicCurves, ink: Palette) -> None:
    """Draw magnitude, phase and coherence of all modes in the three `panels` of a column, in this order.

    Points of less coherence than MIN_COHERENCE are left out of magnitude and phase. `curves` come from `analyse`.
    """
    magnitude, phase, coherence = panels
    for mode, color in zip(MODES, (ink.error, ink.drive, ink.measured), strict=True):
        hz, decibels, degrees, coherences = curves["measured"][mode].T
        mask = np.where(coherences >= MIN_COHERENCE, 1.0, np.nan)
        style = {"color": color, "markersize": 3, "linewidth": 0.9}
        magnitude.plot(hz, decibels * mask, "o-", label=NAMES[mode], **style)
        phase.plot(hz, unwrap_phases(degrees, mask), "o-", **style)
        coherence.plot(hz, coherences, "o-", **style)
    for label, is_dashed, hz, decibels in curves["modelled"]:
        magnitude.plot(hz, decibels, color=ink.model, linewidth=0.8, linestyle="--" if is_dashed else "-", label=label)
    claim = curves["claimed"]
    if claim is not None and claim.at_least is not None and claim.at_most is not None:
        label = f"resonance as claimed: {claim.says}"
        magnitude.axvspan(claim.at_least, claim.at_most, color=ink.limit, alpha=0.25, linewidth=0, label=label)


def unwrap_phases(degrees: Real, mask: Real) -> Real:
    """Return phases in ° without jumps of a turn from one trusted point to the next.

    `mask` is 1 for trusted points, NaN for others, whose phases become NaN.
    """
    phases, is_trusted = degrees * mask, mask == 1.0
    phases[is_trusted] = np.degrees(np.unwrap(np.radians(degrees[is_trusted])))
    return phases


EXPERIMENT = Experiment(
    "harmonic",
    "Harmonic response",
    "Stepped sines from 0.01 Hz to beyond the resonance, three times: the drive alone, with feedforward, and with "
    "feedforward and feedback.",
    HarmonicOptions,
    runs,
    analyse,
    draw,
    defaults={"frequencies_hz": default_frequencies},
    limits={"amplitude_um": largest_swept_sine},
    size=(11.0, 8.0),
)
