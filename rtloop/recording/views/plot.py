"""Picture of a recording: reference and position, error and drive of every axis, timing, events."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rtloop.errors import OutputError, output_errors
from rtloop.foundation.trusted import overwrite_file
from rtloop.recording.file.run_readers import RecordingPaths, ReportTicks
from rtloop.recording.load import Recording, load
from rtloop.recording.views.bands import (
    Band,
    DrawnRecording,
    Mark,
    full_rate_spans,
    read_drawing,
    recording_title,
    signal_kind,
)
from rtloop.recording.views.picture import DOTS_PER_INCH, create_picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = (".png", ".pdf", ".svg")
POINTS = 20_000
MAX_LABELS = 12
LABEL_DISTANCE = 0.025
"""Least horizontal distance of two labels, as a share of the panel's width: 8 points of text at 30° need it."""
USUAL, HIDING = 0.75, 20.0
"""Quantile of an error that its peaks exceed by this factor where they would hide it."""
COLOURS = {
    "reference": "0.15", "position": "tab:blue", "error": "tab:red", "drive": "tab:green",
    "exec": "0.6", "lateness": "tab:purple",
}  # fmt: skip
OTHER_COLOUR = "tab:brown"
WIDE_LINES = {"position": 2.0}
"""Line widths in points of signals drawn below others; all other lines have 0.8."""
FULL_RATE_COLOUR = "gold"
"""Background of the spans recorded at the full rate; the rest is an overview."""


def plot(
    files: RecordingPaths | Recording,
    output: Path | str | None = None,
    *,
    start_s: float = 0.0,
    end_s: float = np.inf,
    progress: ReportTicks | None = None,
) -> Path:
    """Write a picture of a recording from `start_s` to `end_s`, both included, in s since the start. Returns its path.

    `output` is by default NAME.png beside the recording. Its suffix, one of FORMATS, selects the format; an existing
    file is overwritten. Raises RecordingError if no tick or signal can be drawn, OutputError for another suffix or a
    file that cannot be written, MissingExtra without matplotlib.
    """
    target = None if output is None else Path(output)
    if target is not None and target.suffix not in FORMATS:
        raise OutputError(f"{target}: {target.suffix!r} is not a picture format; allowed: {', '.join(FORMATS)}")
    recording = files if isinstance(files, Recording) else load(files)
    figure = draw_recording(recording, start_s, end_s, progress)
    target = target or recording.paths[0].with_suffix(FORMATS[0])
    with output_errors(target), os.fdopen(overwrite_file(target), "wb") as file:
        figure.savefig(file, format=target.suffix[1:], dpi=DOTS_PER_INCH)
    return target


def draw_recording(
    recording: Recording, start_s: float = 0.0, end_s: float = np.inf, progress: ReportTicks | None = None
) -> Figure:
    """Return a picture of a recording between two times, both included, in s since the start.

    `progress` receives the number of ticks read. Raises RecordingError if no tick or signal can be drawn, MissingExtra
    without matplotlib.
    """
    drawing = read_drawing(recording, start_s, end_s, POINTS, progress)
    figure = create_picture(12, 2.0 + 2.1 * len(drawing.panels))
    _draw(figure, drawing)
    first_s, last_s = drawing.time_s[0], drawing.time_s[-1]
    for begin, end in full_rate_spans(drawing.recording):
        if begin <= last_s and end >= first_s:
            for panel in figure.axes:
                panel.axvspan(max(begin, first_s), min(end, last_s), color=FULL_RATE_COLOUR, alpha=0.25, linewidth=0)
    figure.suptitle(recording_title(drawing.recording), fontsize=11, parse_math=False)
    return figure


def _draw(figure: Figure, drawing: DrawnRecording) -> None:
    """Draw all panels, one below the other, and the marks of the events."""
    panels, bands = drawing.panels, drawing.bands
    plots = list(np.ravel(figure.subplots(len(panels), 1, sharex=True)))
    for subplot, panel in zip(plots, panels, strict=True):
        for name in panel.names:
            _draw_trace(subplot, bands[name], signal_kind(name))
        label = f"{panel.label.replace('_', ' ')} / {panel.unit}"
        if (linear := _linear_part([bands[name] for name in panel.names if signal_kind(name) == "error"])) > 0:
            subplot.set_yscale("symlog", linthresh=linear)
            label += f"\nlogarithmic beyond ±{linear:.2g}"
        subplot.set_ylabel(label, parse_math=False)
        subplot.grid(visible=True, alpha=0.3)
        subplot.margins(x=0)
        subplot.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, edgecolor="none")
    plots[-1].set_xlabel("time since the start of the run / s")
    _mark_events(plots, drawing.marks)


def _linear_part(errors: list[Band]) -> float:
    """Return the end of the linear part of an axis on which peaks do not hide the ripple between them.

    It is the power of ten next to the USUAL quantile of the sizes of errors with larger peaks than HIDING times this; 0
    without such peaks.
    """
    sizes = np.abs([*(error.low for error in errors), *(error.high for error in errors)]).ravel()
    sizes = sizes[np.isfinite(sizes)]
    usual = float(np.quantile(sizes, USUAL)) if sizes.size else 0.0
    if usual == 0.0 or sizes.max() <= HIDING * usual:
        return 0.0
    return float(10.0 ** np.round(np.log10(usual)))  # so that no tick lies within the linear part


def _draw_trace(subplot: Axes, band: Band, kind: str) -> None:
    """Draw a band as one line if its extremes are equal everywhere, else as two lines with the area between them."""
    color = COLOURS.get(kind, OTHER_COLOUR)
    line = {"color": color, "linewidth": WIDE_LINES.get(kind, 0.8), "zorder": 1.9 if kind in WIDE_LINES else 2.0}
    subplot.plot(band.time_s, band.low, label=kind, **line)
    if not band.is_line:
        subplot.plot(band.time_s, band.high, **line)
        subplot.fill_between(band.time_s, band.low, band.high, color=color, alpha=0.5, linewidth=0)


def _mark_events(panels: list[Axes], events: list[Mark]) -> None:
    """Draw a line at each event in every panel, and the labels of the first MAX_LABELS events above the top panel.

    A label that would lie on the one before is moved to the right, and a line leads to it.
    """
    for event in events:
        for panel in panels:
            panel.axvline(event.time_s, color="tab:red" if event.bad else "0.3", linewidth=0.7, linestyle=":")
    place_s, end_s = -np.inf, panels[0].get_xlim()[1]
    distance_s = LABEL_DISTANCE * (end_s - panels[0].get_xlim()[0])
    transform = panels[0].get_xaxis_transform()
    for event in events[:MAX_LABELS]:
        place_s = max(event.time_s, place_s + distance_s)
        color = "tab:red" if event.bad else "0.3"
        panels[0].annotate(
            event.label, (event.time_s, 1.0), (place_s, 1.06), transform, transform, rotation=30, fontsize=8,
            parse_math=False, color=color, annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": color, "linewidth": 0.7, "shrinkA": 0, "shrinkB": 0,
                        "relpos": (0, 0)},
        )  # fmt: skip
