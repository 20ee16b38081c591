"""Recording as a DataFrame of pandas or a Dataset of xarray, with units and events as attributes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np

from rtloop.errors import MissingExtra
from rtloop.foundation.arrays import Real
from rtloop.recording.columns import describe_signal
from rtloop.recording.recorded_signals import RecordedSignals
from rtloop.recording.views.selection import Selection

if TYPE_CHECKING:
    import pandas
    import xarray

TIME = "time_s"


def to_pandas(recording: RecordedSignals, selection: Selection) -> pandas.DataFrame:
    """Return a DataFrame of tick, deadline_ns and the selected signals over the time in s since the start of the run.

    Its `attrs` have `recording` (the path), `name`, `rate_hz`, `units` and `events`. Raises RecordingError if a pattern
    fits no signal or a limited time span holds no tick, MissingExtra without pandas.
    """
    try:
        import pandas
    except ImportError:
        raise MissingExtra("a data frame needs pandas: pip install 'rtloop[data]'") from None
    signals = _selected_signals(recording, selection)
    frame = pandas.DataFrame(signals, index=pandas.Index(signals["deadline_ns"] * 1e-9, name=TIME))
    units = {name: recording.units[name] for name in signals}
    frame.attrs = {**_recording_attributes(recording), "units": units, "events": recording.events}
    return frame


def to_xarray(recording: RecordedSignals, selection: Selection) -> xarray.Dataset:
    """Return a Dataset of tick, deadline_ns and the selected signals over the time in s since the start of the run.

    Each signal has `units` and `long_name`. The Dataset's `attrs` have `recording` (the path), `name`, `rate_hz` and
    `events` (JSON text). Raises RecordingError if a pattern fits no signal or a limited time span holds no tick,
    MissingExtra without xarray.
    """
    try:
        import xarray
    except ImportError:
        raise MissingExtra("a data set needs xarray: pip install 'rtloop[data]'") from None
    signals = _selected_signals(recording, selection)
    variables = {
        name: (TIME, values, {"units": recording.units[name], "long_name": describe_signal(name).meaning or name})
        for name, values in signals.items()
    }
    time = (TIME, signals["deadline_ns"] * 1e-9, {"units": "s", "long_name": "time since the start of the run"})
    return xarray.Dataset(
        variables, {TIME: time}, _recording_attributes(recording) | {"events": json.dumps(recording.events)}
    )


def _selected_signals(recording: RecordedSignals, selection: Selection) -> dict[str, Real]:
    """Return the selected ticks of tick, deadline_ns and the selected signals: arrays (ticks,) by name.

    Raises RecordingError if a pattern fits no signal or a limited time span holds no tick.
    """
    names = selection.selected_names(recording)
    blocks = list(selection.read_blocks(recording, names)) or [np.empty((0, len(names)))]
    return {name: np.concatenate([rows[:, index] for rows in blocks]) for index, name in enumerate(names)}


def _recording_attributes(recording: RecordedSignals) -> dict[str, object]:
    """Attributes of a DataFrame or Dataset: {recording (path of the first file), name, rate_hz}."""
    return {"recording": str(recording.paths[0]), **{key: recording.header[key] for key in ("name", "rate_hz")}}
