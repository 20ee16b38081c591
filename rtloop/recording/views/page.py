"""Self-contained HTML page of a recording, with zoom and pan: no network, no other file, light and dark."""

from __future__ import annotations

import base64
import json
import os
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rtloop.errors import output_errors
from rtloop.foundation.arrays import Real
from rtloop.foundation.trusted import overwrite_file
from rtloop.recording.file.run_readers import RecordingPaths, ReportTicks
from rtloop.recording.load import Recording
from rtloop.recording.views.bands import Band, DrawnRecording, Panel, read_drawing, recording_title, signal_kind
from rtloop.values import render_page

POINTS = 100_000
"""About 5 MiB of page for one axis; the page itself draws the extremes of every pixel column."""
COLOURED = ("reference", "position", "error", "drive", "exec", "lateness")
WIDTHS = {"position": 1.5}
"""Line widths in pixels that differ from 1."""


def write_page(
    files: RecordingPaths | Recording,
    output: Path | str | None = None,
    *,
    start_s: float = 0.0,
    end_s: float = np.inf,
    progress: ReportTicks | None = None,
) -> Path:
    """Write the page of a recording from `start_s` to `end_s`, both included, in s since the start.

    `output` is by default NAME.html beside the recording. An existing file is overwritten. Returns the path of the
    page. Raises RecordingError if no tick or signal can be drawn, OutputError if the page cannot be written.
    """
    drawing = read_drawing(files, start_s, end_s, POINTS, progress)
    recording = drawing.recording
    target = recording.paths[0].with_suffix(".html") if output is None else Path(output)
    data = {
        "about": _page_subtitle(drawing),
        "problems": recording.problems,
        "time_s": _encode_base64(drawing.time_s, np.float64),
        "panels": [_panel_data(panel, drawing.bands) for panel in drawing.panels],
        "events": [mark._asdict() for mark in drawing.marks],
    }
    embedded = json.dumps(data).replace("<", "\\u003c")
    with output_errors(target), os.fdopen(overwrite_file(target), "w", encoding="utf-8") as file:
        file.write(render_page(__package__, title=recording_title(recording), data=embedded))
    return target


def _page_subtitle(drawing: DrawnRecording) -> str:
    """Text of file name, processor, kernel of the operating system, and number and kind of the points."""
    recording, host = drawing.recording, drawing.recording.header.get("host", {})
    has_lines = all(band.is_line for band in drawing.bands.values())
    content = "one for every tick" if has_lines else "each with the least and largest value of its ticks"
    points = f"{len(drawing.time_s):,} points, {content}"
    parts = [recording.paths[0].name, host.get("cpu"), host.get("kernel"), points]
    return " · ".join(filter(None, parts))


def _panel_data(panel: Panel, bands: dict[str, Band]) -> dict[str, object]:
    """Panel as {unit, traces} for the page."""
    traces = [_trace_data(bands[name], name) for name in panel.names]
    return {"unit": panel.unit, "traces": traces}


def _trace_data(band: Band, name: str) -> dict[str, object]:
    """Band as {label, colour, width, low, high} for the page; `high` is None if it equals `low` everywhere.

    `low` and `high` are single-precision values in base64, `width` is in pixels, `colour` one of COLOURED or "other".
    """
    kind, high = signal_kind(name), None if band.is_line else _encode_base64(band.high, np.float32)
    label = "tick" if kind == "exec" else kind if name.startswith(kind) else f"{name[: name.index(f'_{kind}_')]} {kind}"
    colour, width = kind if kind in COLOURED else "other", WIDTHS.get(kind, 1.0)
    return {"label": label, "colour": colour, "width": width, "low": _encode_base64(band.low, np.float32), "high": high}


def _encode_base64(values: Real, dtype: npt.DTypeLike) -> str:
    """Values as little-endian bytes of `dtype` in base64."""
    return base64.b64encode(np.asarray(values).astype(np.dtype(dtype).newbyteorder("<")).tobytes()).decode()
