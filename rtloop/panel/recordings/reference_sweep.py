"""A sweep from a recording, which the scope shows beside the running loop."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from rtloop.client.ticks.tick_stretch import column_index
from rtloop.foundation.arrays import Real
from rtloop.foundation.trusted import open_without_link
from rtloop.panel.feed.envelope import envelope
from rtloop.panel.protocol.frames import pack_envelopes, pack_frame
from rtloop.panel.protocol.subscriptions import MAX_PIXELS
from rtloop.panel.recordings.folder import shown_name
from rtloop.recording.cutting.seek import ChunkSeeker
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.topics.ticks import LARGEST
from rtloop.signals import TICK

MAX_VALUES = 10_000_000
"""Most values in memory for one sweep, 80 MB."""
MAX_SIGNALS = 8


class SweepRequest(BaseModel):
    """Signals and ticks of a sweep. Without `first` it covers the ticks that a cut was made for, or the recording."""

    model_config = ConfigDict(extra="forbid")

    signals: tuple[str, ...] = Field(min_length=1, max_length=MAX_SIGNALS)
    first: int | None = Field(default=None, ge=0, le=int(LARGEST))
    ticks: int | None = Field(default=None, ge=1, le=MAX_VALUES)
    trigger: int | None = Field(default=None, ge=0, le=int(LARGEST))
    """Tick from which offsets are counted; None: the first tick."""
    pixels: int = Field(default=1200, ge=1, le=MAX_PIXELS)


def sweep_frame(path: Path, request: SweepRequest) -> bytes:
    """Return a recording's sweep as the binary message "sweep" of the scope, with run −1 and the name of the file.

    Raises ValueError for ticks or signals that are not in the recording and for more than MAX_VALUES values,
    RecordingError for an unreadable file.
    """
    with Reader(path, tolerant=True, opener=open_without_link) as reader:
        seeker = ChunkSeeker(reader)
        first, end = _tick_range(seeker, request)
        values = _read_values(seeker, [column_index(name, reader.columns) for name in request.signals], first, end)
        points = envelope(values, request.pixels)
        trigger = first if request.trigger is None else request.trigger
        header = {"run": -1, "first": first, "trigger": trigger, "end": end, "cause": "recording", "uncertain_ticks": 0}
        view_fields = {"number": 0, "complete": True, "rate_hz": reader.header["rate_hz"], "signals": request.signals}
        offset = points.sample + (first - trigger)
        arrays = {"offset": offset, **pack_envelopes(request.signals, points.low, points.high)}
        return pack_frame("sweep", header | view_fields | {"file": shown_name(path.name)}, arrays)


def _tick_range(seeker: ChunkSeeker, request: SweepRequest) -> tuple[int, int]:
    """Return the first tick of the requested sweep and the tick after its last one.

    Raises ValueError for ticks that are not in the recording, and for more than MAX_VALUES values.
    """
    first_span, last_span, cut = seeker.first_span(), seeker.last_span(), seeker.reader.header.get("cut")
    if first_span is None or last_span is None:
        raise ValueError("the recording holds no ticks")
    first, end = (first_span.first, last_span.last + 1) if cut is None else (cut["first"], cut["end"])
    first = first if request.first is None else request.first
    end = end if request.ticks is None else first + request.ticks
    if not first_span.first <= first < end <= last_span.last + 1:
        present = f"{first_span.first} to {last_span.last}"
        raise ValueError(f"ticks {first} to {end - 1}: not in the recording; allowed: {present}")
    if (end - first) * len(request.signals) > MAX_VALUES:
        max_ticks = MAX_VALUES // len(request.signals)
        raise ValueError(f"ticks: {end - first}; allowed with {len(request.signals)} signals: at most {max_ticks}")
    return first, end


def _read_values(seeker: ChunkSeeker, columns: Sequence[int], first: int, end: int) -> Real:
    """Return columns, by their indices, of ticks `first` … `end` − 1: (columns, end − first), NaN for missing ticks."""
    values = np.full((len(columns), end - first), np.nan)
    for chunk in range(seeker.find_place(first), min(seeker.find_place(end - 1) + 1, seeker.end)):
        rows = seeker.rows(chunk, first, end)
        if len(rows):
            values[:, rows[:, TICK].astype(np.intp) - first] = rows[:, columns].T
    return values
