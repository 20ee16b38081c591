"""A picture of a recording: reference and position, error and drive of every axis, timing, events."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rtloop.errors import MissingExtra, OutputError
from rtloop.recording.file.parts import Files
from rtloop.recording.load import Recording, load, unit_of
from rtloop.recording.views.bands import Band, Mark, Progress, drawn_signals, kept_spans, marks, read_bands, title

FORMATS = (".png", ".pdf", ".svg")
POINTS = 20_000
MAX_LABELS = 12
REFERENCE, POSITION, ERROR, DRIVE, LATENESS = "0.15", "tab:blue", "tab:red", "tab:green", "tab:purple"
KEPT = "gold"
"""Behind what is recorded at the full rate, where the rest is an overview."""


def plot(
    files: Files | Recording,
    output: Path | str | None = None,
    *,
    start_s: float = 0.0,
    end_s: float = np.inf,
    progress: Progress | None = None,
) -> Path:
    """Write a picture of the time from `start_s` to `end_s`, by default a PNG beside the recording.

    The output's ending says of which format, one of FORMATS.
    Raises RecordingError, OutputError, MissingExtra.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("a plot needs matplotlib: pip install 'rtloop[plot]'") from None
    target = None if output is None else Path(output)
    if target is not None and target.suffix not in FORMATS:
        raise OutputError(f"{target}: no picture ends in {target.suffix!r}; possible are {', '.join(FORMATS)}")
    recording = files if isinstance(files, Recording) else load(files)
    target = target or recording.paths[0].with_suffix(FORMATS[0])
    axes = recording.header["axes"]
    bands = read_bands(recording, drawn_signals(recording), start_s, end_s, POINTS, progress)
    time_s = next(iter(bands.values())).time_s
    figure = Figure(figsize=(12, 2.0 + 2.1 * (3 * len(axes) + 1)), layout="constrained")
    FigureCanvasAgg(figure)
    _draw(figure, axes, bands, marks(recording, time_s[0], time_s[-1]))
    for begin, end in kept_spans(recording):
        if begin <= time_s[-1] and end >= time_s[0]:
            for panel in figure.axes:
                panel.axvspan(max(begin, time_s[0]), min(end, time_s[-1]), color=KEPT, alpha=0.25, linewidth=0)
    figure.suptitle(title(recording), fontsize=11, parse_math=False)
    try:
        figure.savefig(target, format=target.suffix[1:], dpi=110)
    except OSError as error:
        raise OutputError(f"{target}: {error.strerror}") from None
    return target


def _draw(figure: Any, axes: list[str], bands: dict[str, Band], events: list[Mark]) -> None:
    panels = list(np.ravel(figure.subplots(3 * len(axes) + 1, 1, sharex=True)))
    for index, axis in enumerate(axes):
        position, error, drive = panels[3 * index : 3 * index + 3]
        _trace(position, bands, f"{axis}_position_um", "position", POSITION, linewidth=2.0)
        _trace(position, bands, f"{axis}_reference_um", "reference", REFERENCE)
        position.set_ylabel(f"{axis} / µm")
        _trace(error, bands, f"{axis}_error_um", "error", ERROR)
        _trace(drive, bands, f"{axis}_drive_v", "drive", DRIVE)
    _timing(panels[-1], bands)
    for panel in panels:
        panel.grid(visible=True, alpha=0.3)
        panel.margins(x=0)
        panel.legend(loc="upper right", fontsize=8, framealpha=0.8, ncols=2)
    panels[-1].set_xlabel("time since the start of the run / s")
    _mark_events(panels, events)


def _trace(panel: Any, bands: dict[str, Band], name: str, label: str, color: str, linewidth: float = 0.8) -> None:
    band = bands[name]
    panel.plot(band.time_s, band.low, color=color, linewidth=linewidth, label=label)
    if not band.thin:
        panel.plot(band.time_s, band.high, color=color, linewidth=linewidth)
        panel.fill_between(band.time_s, band.low, band.high, color=color, alpha=0.5, linewidth=0)
    panel.set_ylabel(f"{name.rpartition('_')[0].replace('_', ' ')} / {unit_of(name)}")


def _timing(panel: Any, bands: dict[str, Band]) -> None:
    """Lateness and execution time; in virtual time there is none."""
    if np.isnan(bands["lateness_us"].high).all():
        panel.text(0.5, 0.5, "virtual time: nothing was measured", transform=panel.transAxes, ha="center")
        panel.plot([], [], label="lateness")
        panel.set_yticks([])
        return
    for name, color in (("exec_us", "0.6"), ("lateness_us", LATENESS)):
        _trace(panel, bands, name, name.removesuffix("_us"), color)
    panel.set_ylabel("timing / µs")


def _mark_events(panels: list[Any], events: list[Mark]) -> None:
    """A line at each event, and what it was above the topmost panel."""
    for event in events:
        for panel in panels:
            panel.axvline(event.time_s, color="tab:red" if event.bad else "0.3", linewidth=0.7, linestyle=":")
    for event in events[:MAX_LABELS]:
        place, above = (event.time_s, 1.02), panels[0].get_xaxis_transform()
        panels[0].text(*place, event.label, transform=above, rotation=30, fontsize=8, parse_math=False)
