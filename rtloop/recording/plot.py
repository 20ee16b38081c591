"""A picture of a recording: reference and position, error and drive of every axis, lateness, events.

Long recordings are drawn as the band from the smallest to the largest value of each stretch of ticks, so that no
peak is lost, whatever the size of the picture.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtloop.recording.errors import MissingExtra, OutputError, RecordingError
from rtloop.recording.events import FINAL
from rtloop.recording.load import Recording, load, unit_of

BINS = 4000
STRETCH = 32
"""Ticks that are reduced to their extremes as they are read, in a long recording."""
RAW_TICKS = 20_000
"""Up to here every tick is drawn."""
MAX_LABELS = 12
REFERENCE, POSITION, ERROR, DRIVE, LATENESS = "0.15", "tab:blue", "tab:red", "tab:green", "tab:purple"


class Band(NamedTuple):
    """Extremes of one signal over stretches of ticks; equal where every tick is a stretch of its own."""

    time_s: Any
    low: Any
    high: Any


def plot(path: Path | str, output: Path | str, *, start_s: float = 0.0, end_s: float = np.inf) -> Path:
    """Write a PNG of the time from `start_s` to `end_s`. Raises RecordingError, OutputError, MissingExtra."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("a plot needs matplotlib: pip install 'rtloop[plot]'") from None
    recording = load(path)
    bands = read_bands(recording, _signals(recording), start_s, end_s)
    figure = Figure(figsize=(12, 2.0 + 2.1 * (3 * len(recording.header["axes"]) + 1)), layout="constrained")
    FigureCanvasAgg(figure)
    _draw(figure, recording, bands)
    try:
        figure.savefig(output, format="png", dpi=110)
    except OSError as error:
        raise OutputError(f"{output}: {error.strerror}") from None
    return Path(output)


def read_bands(recording: Recording, names: list[str], start_s: float, end_s: float) -> dict[str, Band]:
    """Bands of the signals between two times, at most about BINS stretches each."""
    stretch = 1 if _few(recording, start_s, end_s) else STRETCH
    times: list[Any] = []
    lows: list[Any] = []
    highs: list[Any] = []
    for rows in _between(recording, ["deadline_ns", *names], start_s, end_s):
        edges = np.arange(0, len(rows), stretch)
        times.append(rows[edges, 0] * 1e-9)
        lows.append(np.fmin.reduceat(rows[:, 1:], edges))
        highs.append(np.fmax.reduceat(rows[:, 1:], edges))
    if not times:
        raise RecordingError(f"{recording.paths[0]}: holds no tick between {start_s:g} s and {end_s:g} s")
    time_s, low, high = np.concatenate(times), np.concatenate(lows), np.concatenate(highs)
    if stretch > 1:
        edges = np.arange(0, len(time_s), max(len(time_s) // BINS, 1))
        time_s, low, high = time_s[edges], np.fmin.reduceat(low, edges), np.fmax.reduceat(high, edges)
    return {name: Band(time_s, low[:, index], high[:, index]) for index, name in enumerate(names)}


def _few(recording: Recording, start_s: float, end_s: float) -> bool:
    count = 0
    for rows in _between(recording, ["deadline_ns"], start_s, end_s):
        count += len(rows)
        if count > RAW_TICKS:
            return False
    return True


def _between(recording: Recording, names: list[str], start_s: float, end_s: float) -> Iterator[Any]:
    """Blocks between two times; `names` begins with the deadline."""
    for rows in recording.blocks(names):
        inside = (rows[:, 0] >= start_s * 1e9) & (rows[:, 0] <= end_s * 1e9)
        if inside.any():
            yield rows[inside]


def _signals(recording: Recording) -> list[str]:
    axes = recording.header["axes"]
    wanted = ("reference_um", "position_um", "error_um", "drive_v")
    return [*(f"{axis}_{name}" for axis in axes for name in wanted), "lateness_us", "exec_us"]


def _draw(figure: Any, recording: Recording, bands: dict[str, Band]) -> None:
    axes = recording.header["axes"]
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
    _mark_events(panels, recording, next(iter(bands.values())).time_s)
    header = recording.header
    rate = f"{header['rate_hz']:g} Hz, {'paced' if header['paced'] else 'virtual time'}"
    figure.suptitle(f"{header.get('name', recording.paths[0].name)}   ({rate})", fontsize=11)


def _trace(panel: Any, bands: dict[str, Band], name: str, label: str, color: str, linewidth: float = 0.8) -> None:
    band = bands[name]
    panel.plot(band.time_s, band.low, color=color, linewidth=linewidth, label=label)
    if not np.array_equal(band.low, band.high, equal_nan=True):
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


def _mark_events(panels: list[Any], recording: Recording, time_s: Any) -> None:
    """A line at each event in view, and what it was above the topmost panel."""
    inside = [
        event
        for event in recording.events
        if event["kind"] not in FINAL and time_s[0] <= event["time_ns"] * 1e-9 <= time_s[-1]
    ]
    for event in inside:
        color = "tab:red" if event["kind"] in ("tripped", "driver_failed", "gap") else "0.3"
        for panel in panels:
            panel.axvline(event["time_ns"] * 1e-9, color=color, linewidth=0.7, linestyle=":")
    for event in inside[:MAX_LABELS]:
        causes = ", ".join(event["what"].get("causes", []))
        text = event["what"].get("mode") or f"{event['kind']}{': ' if causes else ''}{causes}"
        place = (event["time_ns"] * 1e-9, 1.02)
        label = text.replace("_", " ")
        panels[0].text(*place, label, transform=panels[0].get_xaxis_transform(), rotation=30, fontsize=8)
