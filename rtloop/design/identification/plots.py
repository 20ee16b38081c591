"""Figures of identification: loop and model, response and modes, residual of the compensation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rtloop.design.figures import create_figure, label_panel, save_figure
from rtloop.design.identification.dynamics.dynamics_fit import DynamicsFit
from rtloop.design.identification.dynamics.excitation import LoopExcitation
from rtloop.design.identification.dynamics.instrumental import residual_noise
from rtloop.design.identification.dynamics.prediction_error import Excitation
from rtloop.design.identification.frequency_response import FrequencyResponse
from rtloop.design.identification.hysteresis.judgement import Judgement
from rtloop.design.identification.hysteresis.recording_set import HysteresisFit
from rtloop.foundation.arrays import Real
from rtloop.hysteresis.compensation import Residual, compensated_output
from rtloop.hysteresis.play_model import PlayModel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POINTS = 20_000
"""Largest number of samples drawn over time."""


def draw_hysteresis(fit: HysteresisFit, judgements: Sequence[Judgement]) -> Figure:
    """Return a picture of measured and modelled loops (Fig 4 of the paper) and the errors, each recording held out of
    its model.

    Errors where the memory is not known, but estimated, are pale. Raises MissingExtra without matplotlib.
    """
    figure, (loop_panel, time_panel, drive_panel) = create_figure(1, 3, (17, 5))
    for i, judgement in enumerate(judgements):
        name = {"label": Path(judgement.name).name} if len(judgements) > 1 else {}
        color = f"C{i}"
        position, time_s = judgement.position_um - judgement.offset_um, judgement.time_s - judgement.time_s[0]
        loop_panel.plot(judgement.drive_v, position, color=color, linewidth=2, **({"label": "measured"} | name))
        model = {"label": "model, held out"} if i == len(judgements) - 1 else {}
        loop_panel.plot(judgement.drive_v, position - judgement.error_um, color="0.15", linewidth=0.8, **model)
        time_panel.plot(time_s, judgement.error_um, color=color, linewidth=0.8, **name)
        drive_panel.plot(judgement.drive_v, judgement.error_um, color=color, linewidth=0.8)
        time_panel.plot(time_s, judgement.early_error_um, color=color, linewidth=0.8, alpha=0.3)
    label_panel(loop_panel, "drive / V", "position / µm", f"h/H {fit.measured_loop.percent:.2f} % measured, "
           f"{fit.model_loop.percent:.2f} % model")  # fmt: skip
    rms_um = float(np.sqrt(np.mean([judgement.rms_um**2 for judgement in judgements if judgement.known_share])))
    label_panel(
        time_panel, "time / s", "measured − model / µm", f"held out: {rms_um:.3g} µm rms", legend=len(judgements) > 1
    )
    label_panel(drive_panel, "drive / V", "measured − model / µm", "the same over the drive", legend=False)
    return figure


def draw_dynamics(fit: DynamicsFit, run: Excitation, measured: FrequencyResponse | None) -> Figure:
    """Return a picture of response and model in time (Fig 5 of the paper) and over frequency.

    `measured` None omits the measured frequency response. Raises MissingExtra without matplotlib.
    """
    figure, (time, frequency) = create_figure(1, 2)
    offset = run.position_um[0]
    count = min(run.input.size, POINTS)
    time_s = np.arange(count) * run.period_s
    time.plot(time_s, run.position_um[:count], color="tab:blue", linewidth=2, label="measured")
    residual_um = residual_noise(fit.model, run) if isinstance(run, LoopExcitation) else None
    modelled = fit.model.simulate_output(run.input) + offset if residual_um is None else run.position_um - residual_um
    time.plot(time_s, modelled[:count], color="0.15", linewidth=0.8, label="model")
    label_panel(time, "time / s", "position / µm", f"fit {fit.fit_percent:.2f} %")
    if measured is not None:
        trusted = measured.is_trusted
        magnitude = np.abs(measured.response[trusted])
        frequency.loglog(measured.hz[trusted], magnitude, ".", color="tab:blue", markersize=3, label="measured")
    hz = np.geomspace(1.0, 0.5 / run.period_s, 4000)
    response = fit.model.discrete().response(np.exp(2j * np.pi * hz * run.period_s))[0]
    frequency.loglog(hz, np.abs(response), color="0.15", linewidth=0.8, label="model")
    modes = ", ".join(f"{mode.frequency_hz:.1f} Hz (ζ {mode.damping:.4f})" for mode in fit.modes)
    label_panel(frequency, "frequency / Hz", "position per input", modes)
    return figure


def plot_compensation(residual: Residual, actuator: PlayModel, inverse: PlayModel, output: Path) -> None:
    """Write a PNG of y over v (Fig 7 of the paper) and of Ω with its bound.

    Raises OutputError if `output` cannot be written, MissingExtra without matplotlib.
    """
    figure, (output_panel, residual_panel) = create_figure(1, 2)
    command: Real = residual.command_um * np.sin(np.linspace(0, 5 * np.pi, 4000))
    y = compensated_output(actuator, inverse, command)
    output_panel.plot(command, y, color="tab:blue", linewidth=1)
    label_panel(output_panel, "v / µm", "y / µm", "output of the inverse compensation", legend=False)
    bound = residual.bound_um(residual.gain)
    residual_panel.plot(command, y - residual.gain * command, color="tab:red", linewidth=1, label="Ω of a sine")
    for sign in (-1, 1):
        residual_panel.axhline(sign * bound, color="0.15", linewidth=0.8, label="±ξ" if sign > 0 else None)
    label_panel(residual_panel, "v / µm", "Ω = y − ρ v / µm", f"ρ {residual.gain:.4f}, ξ {bound:.3g} µm")
    save_figure(figure, output)
