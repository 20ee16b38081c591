"""A recording as a frame of pandas or a data set of xarray, with units and events as attributes."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from rtloop.errors import MissingExtra
from rtloop.recording.load import Recording, describe_signal
from rtloop.recording.views.selection import Selection

TIME = "time_s"


def to_pandas(recording: Recording, selection: Selection) -> Any:
    """A DataFrame, a column a signal, indexed by the time in s since the start. Raises RecordingError, MissingExtra."""
    try:
        import pandas
    except ImportError:
        raise MissingExtra("a data frame needs pandas: pip install 'rtloop[data]'") from None
    signals = _selected_signals(recording, selection)
    frame = pandas.DataFrame(signals, index=pandas.Index(signals["deadline_ns"] * 1e-9, name=TIME))
    units = {name: recording.units[name] for name in signals}
    frame.attrs = {**_recording_attributes(recording), "units": units, "events": recording.events}
    return frame


def to_xarray(recording: Recording, selection: Selection) -> Any:
    """A Dataset over the time in s; `units` and `long_name` of each signal, the events as JSON, which netCDF can hold.

    Raises RecordingError, MissingExtra.
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


def _selected_signals(recording: Recording, selection: Selection) -> dict[str, Any]:
    names = selection.selected_names(recording)
    blocks = list(selection.read_blocks(recording, names)) or [np.empty((0, len(names)))]
    return {name: np.concatenate([rows[:, index] for rows in blocks]) for index, name in enumerate(names)}


def _recording_attributes(recording: Recording) -> dict[str, Any]:
    return {"recording": str(recording.paths[0]), **{key: recording.header[key] for key in ("name", "rate_hz")}}
