"""A recording as a MAT file in ControlDesk's layout, so that a laboratory's scripts read it unchanged.

    NAME.X.Data                          times in s, 1×n, as in every file of one raster
    NAME.Y(k).Name, .Data, .Unit         a signal each, 1×n, with XIndex, Path, Raster
    NAME.Description, NAME.Info          where it comes from; header and events of the recording as JSON

NAME is that of the file. The file is of version 5; beyond LARGEST_V5_BYTES, for which that version would need all of
it in memory, and which it soon cannot hold, of version 7.3: HDF5 as MATLAB writes it, which MATLAB loads alike.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from rtloop.errors import MissingExtra
from rtloop.interchange.hdf5_signals import append, begin, path_of
from rtloop.recording.load import Recording
from rtloop.recording.views.selection import Selection
from rtloop.signals import PER_AXIS

LARGEST_V5_BYTES = 1 << 29
LONGEST_NAME = 63
"""Of a variable in MATLAB."""
USER_BLOCK = 512
HEADER = b"MATLAB 7.3 MAT-file, written by rtloop, HDF5 schema 1.00 ."
RASTER = "tick"

Progress = Callable[[int], None]


def write_mat(recording: Recording, part: IO[bytes], target: Path, selection: Selection, progress: Progress) -> int:
    """The ticks written to `part`, which will be called `target`. Raises RecordingError, OSError, MissingExtra."""
    names = selection.names(recording)
    count = sum(len(rows) for rows in selection.blocks(recording, ["tick"]))
    if 8 * count * (len(names) + 1) <= LARGEST_V5_BYTES:
        _write_v5(recording, part, variable_of(target), selection, count)
        progress(count)
    else:
        _write_v73(recording, part, variable_of(target), selection, progress)
    return count


def variable_of(path: Path) -> str:
    """The variable in a file of this name: its stem, as far as MATLAB takes it."""
    name = re.sub(r"\W", "_", path.stem, flags=re.ASCII)
    return (name if name[:1].isalpha() else f"rec_{name}")[:LONGEST_NAME]


def _write_v5(recording: Recording, part: IO[bytes], variable: str, selection: Selection, count: int) -> None:
    from scipy.io import savemat

    names, done = selection.names(recording), 0
    data = np.empty((len(names), 1, count))
    for rows in selection.blocks(recording, names):
        data[:, 0, done : done + len(rows)] = rows.T
        done += len(rows)
    signals = np.zeros((1, len(names)), [("Data", "O"), *((field, "O") for field in _signal(recording, names[0]))])
    for k, name in enumerate(names):
        signals[0, k] = (data[k], *_signal(recording, name).values())
    time = {"Data": data[names.index("deadline_ns")] * 1e-9, **TIME}
    content = {"X": time, "Y": signals, **_about(recording)}
    savemat(part, {variable: content}, appendmat=False, long_field_names=True)


def _write_v73(recording: Recording, part: IO[bytes], variable: str, selection: Selection, progress: Progress) -> None:
    try:
        import h5py
    except ImportError:
        raise MissingExtra("MAT of version 7.3 needs h5py: pip install 'rtloop[data]'") from None
    names = selection.names(recording)
    with h5py.File(path_of(part), "w", userblock_size=USER_BLOCK) as file:
        content = _structure(file, variable)
        time = _structure(content, "X")
        times = _of_class(begin(time, "Data", column=True), "double")
        _put(time, TIME)
        cells = file.create_group("#refs#")
        signals = [_of_class(begin(cells, f"data_{k}", column=True), "double") for k in range(len(names))]
        _put_signals(_structure(content, "Y"), cells, signals, [_signal(recording, name) for name in names])
        for key, fields in _about(recording).items():
            _put(_structure(content, key), fields)
        ticks = 0
        for rows in selection.blocks(recording, names):
            append(signals, rows)
            append([times], rows[:, [names.index("deadline_ns")]] * 1e-9)
            ticks += len(rows)
            progress(ticks)
    part.seek(0)
    part.write(HEADER.ljust(116) + bytes(8) + b"\x00\x02IM")


TIME: dict[str, str | float] = {"Name": "Time", "Unit": "s", "Raster": RASTER}


def _signal(recording: Recording, name: str) -> dict[str, str | float]:
    """What stands beside a signal's data."""
    axis = next((name.removesuffix(f"_{one.name}") for one in PER_AXIS if name.endswith(f"_{one.name}")), "")
    path = f"rtloop/{axis}/{name}" if axis else f"rtloop/{name}"
    return {"Name": name, "Unit": recording.units[name], "XIndex": 1.0, "Path": path, "Raster": RASTER}


def _about(recording: Recording) -> dict[str, dict[str, str | float]]:
    header = recording.header
    said = f"{header['name']}, recorded by rtloop at {header['rate_hz']:g} Hz"
    about = {"Header": json.dumps(header), "Events": json.dumps(recording.events)}
    return {"Description": {"General": said}, "Info": {"Recording": recording.paths[0].name, **about}}


def _structure(place: Any, name: str) -> Any:
    return _of_class(place.create_group(name), "struct")


def _of_class(one: Any, name: str) -> Any:
    one.attrs["MATLAB_class"] = np.bytes_(name)
    return one


def _put(structure: Any, fields: dict[str, str | float]) -> None:
    for name, value in fields.items():
        _value(structure, name, value)


def _put_signals(structure: Any, cells: Any, data: Sequence[Any], fields: Sequence[dict[str, str | float]]) -> None:
    """A structure array, 1×k: each of its fields is a row of references to what is in `cells`."""
    import h5py

    def refer(name: str, values: Iterable[Any]) -> None:
        references = structure.create_dataset(name, (len(data), 1), h5py.ref_dtype)
        for k, value in enumerate(values):
            references[k, 0] = value.ref

    refer("Data", data)
    for name in fields[0]:
        refer(name, [_value(cells, f"{name}_{k}", one[name]) for k, one in enumerate(fields)])


def _value(place: Any, name: str, value: str | float) -> Any:
    """A text as 1×n characters of 16 bits, or a number."""
    if not isinstance(value, str):
        return _of_class(place.create_dataset(name, data=np.full((1, 1), float(value))), "double")
    if not value:
        empty = _of_class(place.create_dataset(name, data=np.zeros(2, np.uint64)), "char")
        empty.attrs["MATLAB_empty"] = np.uint8(1)
        return empty
    characters = np.frombuffer(value.encode("utf-16-le"), np.uint16).reshape(-1, 1)
    text = _of_class(place.create_dataset(name, data=characters), "char")
    text.attrs["MATLAB_int_decode"] = np.int32(2)
    return text
