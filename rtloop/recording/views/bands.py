"""Reduce signals for drawing to the least and largest value of each group of ticks.

No peak is lost at any picture size.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.recording.columns import signal_unit
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.run_readers import RecordingPaths, ReportTicks
from rtloop.recording.file.topics.events import FINAL
from rtloop.recording.load import Recording, load
from rtloop.signals import DEADLINE, Mode

MAX_DRAWN_VALUE = 1e30
"""Values of this magnitude or more, and NaN, are not drawn; smaller ones fit the single precision of a page."""
FAULT_KINDS = ("tripped", "driver_failed", "gap")
AXIS_PANELS = (("reference_um", "position_um"), ("error_um",), ("drive_v",))
"""Signals of an axis by panel."""
REFERRED = ("_reference_um", "_error_um")
"""Ends of the names of signals that are the reference, or relate to it."""
TIMING = ("exec_us", "lateness_us")
MAX_OTHER_SIGNALS = 8
"""Maximum number of additional panels for other signals of an imported recording."""


class Band(NamedTuple):
    """Least and largest values (n,) of one signal over groups of ticks; equal if each group is a single tick.

    Both are NaN for a group without a value that can be drawn; other NaN are ignored.
    `time_s` (n,) is the deadline of each group's first tick, in s since the start of the run.
    """

    time_s: Real
    low: Real
    high: Real

    @property
    def has_values(self) -> bool:
        """Whether a value can be drawn."""
        return not np.all(np.isnan(self.low))

    @property
    def is_line(self) -> bool:
        """Whether the least value equals the largest one in every group of ticks."""
        return np.array_equal(self.low, self.high, equal_nan=True)


class Mark(NamedTuple):
    """Mark of an event in a picture; `bad` marks a trip, a driver failure or a gap."""

    time_s: float
    label: str
    bad: bool


class Panel(NamedTuple):
    """Signals of one panel."""

    label: str
    unit: str
    names: list[str]


class DrawnRecording(NamedTuple):
    """Recording to draw: its panels, the bands of their signals by name, and the times of the bands."""

    recording: Recording
    panels: list[Panel]
    bands: dict[str, Band]
    time_s: Real

    @property
    def marks(self) -> list[Mark]:
        """Marks of the events in the drawn time."""
        return event_marks(self.recording, float(self.time_s[0]), float(self.time_s[-1]))


def read_drawing(
    files: RecordingPaths | Recording, start_s: float, end_s: float, points: int, progress: ReportTicks | None
) -> DrawnRecording:
    """Read the signals to draw between two times, both included, in s since the start; see `read_bands` for `points`.

    Raises RecordingError if no tick lies between the times or there is no signal to draw.
    """
    recording = files if isinstance(files, Recording) else load(files)
    panels = make_panels(recording)
    bands = read_bands(recording, [name for panel in panels for name in panel.names], start_s, end_s, points, progress)
    time_s = next(iter(bands.values())).time_s
    drawn = [panel._replace(names=[name for name in panel.names if bands[name].has_values]) for panel in panels]
    return DrawnRecording(recording, [panel for panel in drawn if panel.names] or panels, bands, time_s)


def read_bands(
    recording: Recording,
    names: list[str],
    start_s: float,
    end_s: float,
    points: int,
    progress: ReportTicks | None = None,
) -> dict[str, Band]:
    """Read the signals between two times, both included, in s since the start.

    Returns bands of about `points` values, by name. Every tick is a value if there are at most `points`. Omitted ticks
    add up to about 2 `points` values of their overview. Values whose magnitude is MAX_DRAWN_VALUE or more count as NaN,
    and in mode raw, whose reference is in V, the REFERRED signals.
    `progress` receives the number of ticks read. Raises RecordingError if neither a tick nor an overview lies between
    the times.
    """
    count = sum(len(rows) for rows in recording.between(["deadline_ns"], start_s, end_s))
    overview_band = _overview_band(recording, names, start_s, end_s, points)
    if count == 0 and not len(overview_band[0]):
        until = " on" if end_s == np.inf else f" to {end_s:g} s"
        raise RecordingError(f"{recording.paths[0]}: holds no tick from {start_s:g} s{until}")
    ticks_per_point = max(-(-count // points), 1)
    times, lows, highs = [overview_band[0]], [overview_band[1]], [overview_band[2]]
    tick_count = 0
    has_mode = "mode" in recording
    referred = [name.endswith(REFERRED) for name in names]
    for rows in recording.between(["deadline_ns", *names, *(["mode"] if has_mode else [])], start_s, end_s):
        edges = np.arange(0, len(rows), ticks_per_point)
        times.append(rows[edges, 0] * 1e-9)
        values = rows[:, 1 : 1 + len(names)]
        values = np.where(np.abs(values) < MAX_DRAWN_VALUE, values, np.nan)
        if has_mode:
            values[np.ix_(rows[:, -1] == Mode.RAW, referred)] = np.nan
        lows.append(np.fmin.reduceat(values, edges))
        highs.append(np.fmax.reduceat(values, edges))
        tick_count += len(rows)
        if progress:
            progress(tick_count)
    time_s, low, high = np.concatenate(times), np.concatenate(lows), np.concatenate(highs)
    if len(overview_band[0]):
        order = np.argsort(time_s, kind="stable")
        time_s, low, high = time_s[order], low[order], high[order]
    return {name: Band(time_s, low[:, index], high[:, index]) for index, name in enumerate(names)}


def make_panels(recording: Recording) -> list[Panel]:
    """Return the panels of a picture, from the top, each with at least one recorded signal.

    Paced runs also have a panel of timing, imported recordings up to MAX_OTHER_SIGNALS panels of other signals. Raises
    RecordingError if there is no signal to draw.
    """
    axis_panels = [_panel(recording, axis, names) for axis in recording.header["axes"] for names in AXIS_PANELS]
    if recording.header["paced"]:
        axis_panels.append(Panel("timing", "µs", [*filter(recording.__contains__, TIMING)]))
    if "imported" in recording.header:
        panel_signals = {name for panel in axis_panels for name in panel.names}
        other_names = [name for name in recording.columns[DEADLINE + 1 :] if name not in panel_signals]
        axis_panels += [Panel(name, recording.units[name], [name]) for name in other_names[:MAX_OTHER_SIGNALS]]
    if not any(panel.names for panel in axis_panels):
        raise RecordingError(f"{recording.paths[0]}: holds no signal that could be drawn")
    return [panel for panel in axis_panels if panel.names]


def _panel(recording: Recording, axis: str, names: Sequence[str]) -> Panel:
    """Panel of the recorded ones among the signals `names` of an axis, such as error_um; [] as `names` without any."""
    present = [name for signal in names if (name := f"{axis}_{signal}") in recording]
    label = axis if len(names) > 1 else f"{axis} {signal_kind(names[0])}"
    if names == ("error_um",) and axis in _filtered_axes(recording):
        label += "\nbehind the pre-filter"
    return Panel(label, signal_unit(names[0]), present)


def _filtered_axes(recording: Recording) -> list[str]:
    """Return the axes whose reference a pre-filter shapes before the error is formed; [] if this cannot be read."""
    try:
        tables = tomllib.loads(recording.header["configuration"]).get("axis", [])
        return [table["name"] for table in tables if table.get("prefilter")]
    except (tomllib.TOMLDecodeError, AttributeError, KeyError, TypeError):
        return []


def signal_kind(name: str) -> str:
    """Return the kind of a signal, which sets its style: `position` for `x_position_um`, `exec` for `exec_us`.

    The kind is the word before the unit if word and unit form a signal of AXIS_PANELS or TIMING, else the whole name.
    """
    kind = name.rpartition("_")[0].rpartition("_")[2]
    suffixes = [signal for names in (*AXIS_PANELS, TIMING) for signal in names]
    return kind if f"{kind}_{name.rpartition('_')[2]}" in suffixes else name


def _overview_band(
    recording: Recording, names: list[str], start_s: float, end_s: float, points: int
) -> tuple[Real, Real, Real]:
    """Return times (n,) in s, least and largest values (n, names) of the ticks omitted between two times.

    n is 2 for each group of intervals, up to about 2 `points` altogether, and 0 if no tick was omitted.
    """
    empty = np.empty((0, len(names)))
    if not recording.skipped:
        return np.empty(0), empty, empty
    overview = recording.overview
    in_interval = (overview.time_s >= start_s) & (overview.time_s <= end_s)
    edges = np.arange(0, np.count_nonzero(in_interval), max(-(-np.count_nonzero(in_interval) // points), 1))
    if not len(edges):
        return np.empty(0), empty, empty
    extremes = [overview[name] for name in names]
    low, high = (
        np.stack([getattr(signal_extremes, part)[in_interval] for signal_extremes in extremes], axis=1)
        for part in ("least", "most")
    )
    low, high = (np.where(np.abs(values) < MAX_DRAWN_VALUE, values, np.nan) for values in (low, high))
    begins_s, ends_s = overview.time_s[in_interval][edges], np.fmax.reduceat(overview.end_s[in_interval], edges)
    times_s = np.stack([begins_s, ends_s], axis=1).ravel()  # The band is level from the start to the end of a group.
    reduced = np.fmin.reduceat(low, edges), np.fmax.reduceat(high, edges)
    return times_s, np.repeat(reduced[0], 2, axis=0), np.repeat(reduced[1], 2, axis=0)


def full_rate_spans(recording: Recording) -> list[tuple[float, float]]:
    """Spans (start, end) recorded at the full rate, in s since the start of the run; the last one may end at infinity.

    [] if no tick was omitted by intention.
    """
    if not recording.skipped:
        return []
    overview, ticks = recording.overview, recording.skipped
    begins = np.searchsorted(overview.tick, [first for first, _ in ticks])
    ends = np.searchsorted(overview.tick, [first + count for first, count in ticks]) - 1
    edges = [0.0, *np.stack([overview.time_s[begins], overview.end_s[ends]], axis=1).ravel(), np.inf]
    return [(float(a), float(b)) for a, b in zip(edges[::2], edges[1::2], strict=True) if a < b]


def event_marks(recording: Recording, start_s: float, end_s: float) -> list[Mark]:
    """Marks of the events between two times, both included, in s since the start, without events that end a file.

    The label of a change of mode is the mode; any other event has its kind as label, a trip with its causes, and the
    end of an episode of late ticks with the number of periods missed in it.
    """
    events = []
    for event in recording.events:
        time_s, kind, details = event["time_ns"] * 1e-9, event["kind"], event["what"]
        if kind not in FINAL and start_s <= time_s <= end_s:
            more = ", ".join(details.get("causes", []))
            if kind == "lateness_over":
                more = f"{details['periods']} periods missed"
            label = details.get("mode") or ": ".join(filter(None, [kind, more]))
            events.append(Mark(time_s, label.replace("_", " "), kind in FAULT_KINDS))
    return events


def recording_title(recording: Recording) -> str:
    """Title of a picture: name and rate of a run, and its kind: paced, imported or virtual time."""
    header = recording.header
    clock = "paced" if header["paced"] else "imported" if "imported" in header else "virtual time"
    return f"{header.get('name', recording.paths[0].name)}   ({header['rate_hz']:g} Hz, {clock})"
