"""Export as a MAT file in ControlDesk's layout, so that a laboratory's scripts read it unchanged.

    NAME.X.Data                          times in s, 1×n, as in every file of one raster
    NAME.Y(k).Name, .Data, .Unit         a signal each, 1×n, with XIndex, Path, Raster
    NAME.Description, NAME.Info          origin; header and events of the recording as JSON

NAME is the file's name. The file is of version 5 and written by scipy. All numbers are in memory meanwhile.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import IO

import numpy as np

from rtloop.recording.errors import RecordingError
from rtloop.recording.load import Recording
from rtloop.recording.views.selection import Selection
from rtloop.signals import AXIS_SIGNALS

LARGEST_BYTES = (1 << 31) - (1 << 20)
"""Limit for numbers and texts: a variable of version 5 takes less than 2 GiB, names and headers of the signals
included."""
LONGEST_NAME = 63
"""Length limit for a variable in MATLAB."""
RASTER = "tick"
AXIS_SUFFIXES = tuple(f"_{signal.name}" for signal in AXIS_SIGNALS)
TIME: dict[str, str | float] = {"Name": "Time", "Unit": "s", "Raster": RASTER}


def write_mat(recording: Recording, part: IO[bytes], target: Path, selection: Selection) -> int:
    """Write the selected ticks to the open file `part`, which is renamed to `target` later. Returns their number.

    Raises RecordingError above the 2 GiB of a MAT file, for a pattern that fits no signal and for a limited time span
    without ticks; OSError if the write fails.
    """
    from scipy.io import savemat

    names, about = selection.selected_names(recording), _origin(recording)
    count = sum(len(rows) for rows in selection.read_blocks(recording, ["tick"]))
    size = 8 * count * (len(names) + 1) + sum(len(str(text)) for text in about["Info"].values())
    if size > LARGEST_BYTES:
        raise RecordingError(
            f"{target}: the recording takes {size / 2**30:.1f} GiB; allowed in a MAT file: 2 GiB. Use --to hdf5, or "
            "export less with --signals, --every, --from and --until"
        )
    data, written = np.empty((len(names), 1, count)), 0
    for rows in selection.read_blocks(recording, names):
        data[:, 0, written : written + len(rows)] = rows.T
        written += len(rows)
    signals = np.zeros((1, len(names)), [("Data", "O"), *((field, "O") for field in _signal(recording, names[0]))])
    for k, name in enumerate(names):
        signals[0, k] = (data[k], *_signal(recording, name).values())
    content = {"X": {"Data": data[names.index("deadline_ns")] * 1e-9, **TIME}, "Y": signals, **about}
    savemat(part, {matlab_variable(target): content}, appendmat=False, long_field_names=True)
    return count


def matlab_variable(path: Path) -> str:
    """Return the name of MATLAB's variable for a file: the stem of the file's name, with _ for other characters.

    Other characters are all but ASCII letters, digits and _. The prefix "rec_" is added to a name that does not begin
    with a letter; the result is cut to LONGEST_NAME characters.
    """
    name = re.sub(r"\W", "_", path.stem, flags=re.ASCII)
    return (name if name[:1].isalpha() else f"rec_{name}")[:LONGEST_NAME]


def _signal(recording: Recording, name: str) -> dict[str, str | float]:
    """Return the fields Name, Unit, XIndex, Path and Raster beside a signal's data."""
    axis = next((name[: -len(suffix)] for suffix in AXIS_SUFFIXES if name.endswith(suffix)), "")
    path = f"rtloop/{axis}/{name}" if axis else f"rtloop/{name}"
    return {"Name": name, "Unit": recording.units[name], "XIndex": 1.0, "Path": path, "Raster": RASTER}


def _origin(recording: Recording) -> dict[str, dict[str, str | float]]:
    """Return two structures of texts: Description {General: a sentence on the origin}, and Info {Recording: name of the
    first file, Header and Events: those of the recording as JSON}.
    """
    header = recording.header
    sentence = f"{header['name']}, recorded by rtloop at {header['rate_hz']:g} Hz"
    about = {"Header": json.dumps(header), "Events": json.dumps(recording.events)}
    return {"Description": {"General": sentence}, "Info": {"Recording": recording.paths[0].name, **about}}
