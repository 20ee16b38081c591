"""MAT files in ControlDesk's layout, written and read by scipy, without code of rtloop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, savemat

Array = np.ndarray[Any, Any]


def write_controldesk(path: Path, time_s: Array, signals: dict[str, tuple[Array, str]]) -> None:
    """Write a MAT file; `signals` are (values, unit) by their path in the model."""
    fields = ("Name", "Type", "Data", "Unit", "XIndex", "Path", "Raster")
    y = np.zeros(len(signals), [(field, "O") for field in fields])
    for k, (name, (values, unit)) in enumerate(signals.items()):
        y[k] = (name, 4.0, values[None], unit, 1.0, f"Platform()://{name}", "Periodic Task 1")
    x = {"Name": "Time", "Type": 4.0, "Data": time_s[None], "Unit": "s", "Raster": "Periodic Task 1"}
    about = {"Description": {"General": "scan of 12 April"}, "Info": {"RTProgram": "stage"}}
    savemat(path, {path.stem: {"X": x, "Y": y, **about}}, do_compression=True)


def read_v5(path: Path) -> tuple[Array, dict[str, Array], dict[str, str]]:
    """Return time (s), values and units by name: X.Data, Y(k).Data and Y(k).Unit, which must be rows, as in MATLAB."""
    variable = loadmat(path, struct_as_record=False)[path.stem][0, 0]
    signals = {signal.Name[0]: signal.Data for signal in variable.Y[0]}
    units = {signal.Name[0]: "".join(signal.Unit) for signal in variable.Y[0]}
    time_s = variable.X[0, 0].Data
    assert all(values.shape == time_s.shape == (1, time_s.size) for values in signals.values())
    assert all(signal.XIndex[0, 0] == 1 and signal.Raster[0] == variable.X[0, 0].Raster[0] for signal in variable.Y[0])
    return time_s[0], {name: values[0] for name, values in signals.items()}, units
