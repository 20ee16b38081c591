"""ControlDesk's layout, written and read by what knows nothing else, and nothing of rtloop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy.io import loadmat, savemat

Array = np.ndarray[Any, Any]


def write_controldesk(path: Path, time_s: Array, signals: dict[str, tuple[Array, str]]) -> None:
    """`signals` by their path in the model: values and unit."""
    fields = ("Name", "Type", "Data", "Unit", "XIndex", "Path", "Raster")
    y = np.zeros(len(signals), [(field, "O") for field in fields])
    for k, (name, (values, unit)) in enumerate(signals.items()):
        y[k] = (name, 4.0, values[None], unit, 1.0, f"Platform()://{name}", "Periodic Task 1")
    x = {"Name": "Time", "Type": 4.0, "Data": time_s[None], "Unit": "s", "Raster": "Periodic Task 1"}
    about = {"Description": {"General": "scan of 12 April"}, "Info": {"RTProgram": "stage"}}
    savemat(path, {path.stem: {"X": x, "Y": y, **about}}, do_compression=True)


def read_v5(path: Path) -> tuple[Array, dict[str, Array], dict[str, str]]:
    """X.Data, Y(k).Data by Y(k).Name, Y(k).Unit: as a script of MATLAB takes them, rows all of them."""
    variable = loadmat(path, struct_as_record=False)[path.stem][0, 0]
    signals = {one.Name[0]: one.Data for one in variable.Y[0]}
    units = {one.Name[0]: "".join(one.Unit) for one in variable.Y[0]}
    time_s = variable.X[0, 0].Data
    assert all(values.shape == time_s.shape == (1, time_s.size) for values in signals.values())
    assert all(one.XIndex[0, 0] == 1 and one.Raster[0] == variable.X[0, 0].Raster[0] for one in variable.Y[0])
    return time_s[0], {name: values[0] for name, values in signals.items()}, units


def read_v73(path: Path) -> tuple[Array, dict[str, Array], dict[str, str]]:
    """The same of version 7.3: MATLAB's 1×n is (n, 1) there, and the fields of a structure array are references."""
    head = path.read_bytes()[:128]
    assert head.startswith(b"MATLAB 7.3 MAT-file")
    assert head[124:] == b"\x00\x02IM"
    with h5py.File(path) as file:
        variable = file[path.stem]
        assert variable.attrs["MATLAB_class"] == variable["Y"].attrs["MATLAB_class"] == b"struct"

        def each(field: str) -> list[Any]:
            return [file[place] for place in variable["Y"][field][:, 0]]

        def text(one: Any) -> str:
            assert one.attrs["MATLAB_class"] == b"char"
            return "" if "MATLAB_empty" in one.attrs else "".join(map(chr, one[:, 0]))

        names = [text(one) for one in each("Name")]
        data = dict(zip(names, (one[:, 0] for one in each("Data")), strict=True))
        return variable["X"]["Data"][:, 0], data, dict(zip(names, map(text, each("Unit")), strict=True))
