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
from rtloop.recording.views.picture import create_picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

POINTS = 20_000
"""Largest number of samples drawn over time."""
ZOOM_PERIODS, LEAST_ZOOM = 12, 60
"""Periods of the slowest mode in the part that is drawn enlarged, and its least samples."""


def draw_hysteresis(fit: HysteresisFit, judgements: Sequence[Judgement]) -> Figure:
    """Return a figure of measured and modelled loops (Fig 4 of the paper), and of the held-out errors over time and
    over the drive.

    Errors in blocks whose memory is not known, but estimated, are pale. Raises MissingExtra without matplotlib.
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
        time_panel,
        "time / s",
        "measured − model / µm",
        f"held-out error: {rms_um:.3g} µm rms",
        legend=len(judgements) > 1,
    )
    label_panel(drive_panel, "drive / V", "measured − model / µm", "held-out error over the drive", legend=False)
    return figure


def draw_dynamics(fit: DynamicsFit, run: Excitation, measured: FrequencyResponse | None, input_unit: str) -> Figure:
    """Return a figure of measured and modelled position over time (Fig 5 of the paper), a part of them enlarged, their
    difference, and the responses over frequency, in magnitude and phase.

    `input_unit` is "V" or "µm". The input of `run` is already delayed by the model's delay, which the phase leaves out.
    `measured` None omits the measured frequency response. Raises MissingExtra without matplotlib.
    """
    figure = create_picture(13, 8)
    grid = figure.add_gridspec(6, 2)
    full, zoom, difference = (figure.add_subplot(grid[row : row + 2, 0]) for row in (0, 2, 4))
    magnitude = figure.add_subplot(grid[:3, 1])
    phase = figure.add_subplot(grid[3:, 1], sharex=magnitude)
    _draw_in_time(fit, run, full, zoom, difference)
    _draw_over_frequency(fit, run, measured, magnitude, phase, input_unit)
    return figure


def _draw_in_time(fit: DynamicsFit, run: Excitation, full: Axes, zoom: Axes, difference: Axes) -> None:
    """Draw measured and modelled position over time, an enlarged part of them, and their difference, in a panel each.

    Only the first POINTS samples are drawn.
    """
    residual_um = residual_noise(fit.model, run) if isinstance(run, LoopExcitation) else None
    if residual_um is None:
        residual_um = run.position_um - run.position_um[0] - fit.model.simulate_output(run.input)
    modelled = run.position_um - residual_um
    time_s = np.arange(run.input.size) * run.period_s
    start, end = _zoom_range(fit, run)
    for panel, part, unit_s in ((full, slice(POINTS), 1.0), (zoom, slice(start, end), 1e-3)):
        panel.plot(time_s[part] / unit_s, run.position_um[part], color="tab:blue", linewidth=2, label="measured")
        panel.plot(time_s[part] / unit_s, modelled[part], color="0.15", linewidth=0.8, label="model")
    full.axvspan(time_s[start], time_s[end - 1], color="tab:orange", alpha=0.3, linewidth=0)
    label_panel(full, "time / s", "position / µm", f"fit {fit.fit_percent:.2f} %; the shaded part is enlarged below")
    label_panel(zoom, "time / ms", "position / µm", "shaded part", legend=False)
    difference.plot(time_s[:POINTS], residual_um[:POINTS], color="tab:red", linewidth=0.6)
    rms_um = float(np.sqrt(np.mean(residual_um**2)))
    title = f"output error, measured − simulated: {rms_um:.3g} µm rms"
    label_panel(difference, "time / s", "difference / µm", title, legend=False)


def _zoom_range(fit: DynamicsFit, run: Excitation) -> tuple[int, int]:
    """Return first sample and last sample + 1 of the enlarged part: ZOOM_PERIODS periods of the slowest mode, or
    LEAST_ZOOM samples if these are more, from just before the largest change of the input on.

    The part lies within the first POINTS samples of the run, and is shorter where these are fewer.
    """
    slowest_hz = min((mode.frequency_hz for mode in fit.modes if mode.frequency_hz > 0), default=np.inf)
    length = min(max(round(ZOOM_PERIODS / (slowest_hz * run.period_s)), LEAST_ZOOM), run.input.size, POINTS)
    latest_start = min(run.input.size, POINTS) - length
    largest_change = int(np.argmax(np.abs(np.diff(run.input[: latest_start + length], prepend=run.input[0]))))
    start = min(max(largest_change - length // 20, 0), latest_start)
    return start, start + length


def _draw_over_frequency(
    fit: DynamicsFit, run: Excitation, measured: FrequencyResponse | None, magnitude: Axes, phase: Axes, input_unit: str
) -> None:
    """Draw magnitude and phase of the model, and of a measured response at the frequencies where its `is_trusted` is
    True.
    """
    model = fit.model.discrete()
    hz = np.geomspace(1.0, 0.499 / run.period_s, 4000)
    response = model.response(np.exp(2j * np.pi * hz * run.period_s))[0]
    phase_rad = np.unwrap(np.angle(response))
    if measured is not None:
        measured_hz, values = measured.hz[measured.is_trusted], measured.response[measured.is_trusted]
        points = {"color": "tab:blue", "markersize": 3, "label": "measured"}
        magnitude.loglog(measured_hz, np.abs(values), ".", **points)
        nearby_rad = np.interp(measured_hz, hz, phase_rad)  # the turn of the circle that the model is in
        measured_rad = nearby_rad + np.angle(values * np.exp(-1j * nearby_rad))
        phase.semilogx(measured_hz, np.degrees(measured_rad), ".", **points)
    magnitude.loglog(hz, np.abs(response), color="0.15", linewidth=0.8, label="model")
    phase.semilogx(hz, np.degrees(phase_rad), color="0.15", linewidth=0.8, label="model")
    modes = ", ".join(f"{mode.frequency_hz:.1f} Hz (ζ {mode.damping:.4f})" for mode in fit.modes)
    resolution = "" if measured is None else f"; measured every {measured.resolution_hz:.3g} Hz"
    label_panel(magnitude, "frequency / Hz", f"|position / input| / (µm/{input_unit})", modes + resolution)
    label_panel(phase, "frequency / Hz", "phase / °", "phase without the delay of whole samples", legend=False)


def plot_compensation(residual: Residual, actuator: PlayModel, inverse: PlayModel, output: Path) -> None:
    """Write a PNG of the compensated position y over the command v (Fig 7 of the paper), and of the residual
    Ω = y − ρ v with its bound ±ξ, to `output`, over an existing file.

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
