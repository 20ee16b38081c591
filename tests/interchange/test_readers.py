"""Files of MATLAB, Simulink, ControlDesk, HDF5, numpy and pandas, written by other libraries, are read exactly."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas
import pytest
from scipy.io import savemat

from rtloop.interchange.formats.table import Hints, Table, UnreadableData
from rtloop.interchange.reading import read_in_process
from tests.interchange.controldesk import write_controldesk

TIME = np.arange(500) * 1e-4
DRIVE = np.sin(2 * np.pi * 50 * TIME)
PLACE = 1.3 * DRIVE + 0.01


def has_columns(table: Table, **expected: Any) -> bool:
    """Return whether the columns are exactly the expected ones; `__` in a name stands for /."""
    renamed = {name.replace("__", "/"): values for name, values in expected.items()}
    return {name: values.tobytes() for name, values in table.columns.items()} == {
        name: np.asarray(values, float).tobytes() for name, values in renamed.items()
    }


def structure_array(fields: tuple[str, ...], *rows: tuple[Any, ...]) -> np.ndarray[Any, Any]:
    """Return a structure array as MATLAB has it, with one element for each row."""
    array = np.zeros(len(rows), [(field, "O") for field in fields])
    for k, row in enumerate(rows):
        array[k] = row
    return array


def test_controldesk(tmp_path: Path):
    path = tmp_path / "scan.mat"
    write_controldesk(path, TIME, {"Model Root/Piezo/Out1": (DRIVE, "mV"), "Model Root/Sensor/In1": (PLACE, "")})
    table = read_in_process(path)
    assert has_columns(table, **{"Time": TIME, "Model Root__Piezo__Out1": DRIVE, "Model Root__Sensor__In1": PLACE})
    assert (table.time, table.units["Model Root/Piezo/Out1"]) == ("Time", "mV")
    assert table.about["description"] == "scan of 12 April"


def test_rasters_are_named_and_selected(tmp_path: Path):
    x = structure_array(("Name", "Data", "Raster"), ("", TIME[None], "fast"), ("", TIME[None, ::10], "slow"))
    y = structure_array(("Name", "Data", "XIndex"), ("u", DRIVE[None], 1.0), ("T", PLACE[None, ::10], 2.0))
    savemat(tmp_path / "scan.mat", {"scan": {"X": x, "Y": y}})
    table = read_in_process(tmp_path / "scan.mat")
    assert has_columns(table, Time=TIME, u=DRIVE)
    assert (table.about["group"], table.about["other groups"]) == ("fast", "'slow' (50 rows, 2 columns)")
    assert has_columns(read_in_process(tmp_path / "scan.mat", Hints("slow")), Time=TIME[::10], T=PLACE[::10])
    with pytest.raises(UnreadableData, match="no group 'middle'; there are 'fast', 'slow'"):
        read_in_process(tmp_path / "scan.mat", Hints("middle"))


def test_rasters_of_one_length_keep_apart(tmp_path: Path):
    x = structure_array(("Name", "Data", "Raster"), ("", TIME[None], "fast"), ("", 10 * TIME[None], "slow"))
    y = structure_array(("Name", "Data", "XIndex"), ("u", DRIVE[None], 1.0), ("T", PLACE[None], 2.0))
    savemat(tmp_path / "scan.mat", {"scan": {"X": x, "Y": y}})
    assert has_columns(read_in_process(tmp_path / "scan.mat", Hints("fast")), Time=TIME, u=DRIVE)
    assert has_columns(read_in_process(tmp_path / "scan.mat", Hints("slow")), Time=10 * TIME, T=PLACE)


def test_simulink(tmp_path: Path):
    both = np.column_stack([PLACE, 2 * PLACE])
    signals = structure_array(("values", "label"), (DRIVE[:, None], "drive"), (both, "place"))
    savemat(tmp_path / "a.mat", {"simout": {"time": TIME[:, None], "signals": signals, "blockName": "m/Scope"}})
    table = read_in_process(tmp_path / "a.mat")
    assert has_columns(table, time=TIME, drive=DRIVE, place_1=PLACE, place_2=2 * PLACE)
    assert table.time == "time"
    savemat(tmp_path / "b.mat", {"ts": {"Time": TIME, "Data": DRIVE, "Name": "drive", "DataInfo": {"Units": "V"}}})
    table = read_in_process(tmp_path / "b.mat")
    assert has_columns(table, Time=TIME, drive=DRIVE)
    assert (table.time, table.units) == ("Time", {"drive": "V"})
    savemat(tmp_path / "c.mat", {"ans": np.vstack([TIME, DRIVE, PLACE])})
    assert has_columns(read_in_process(tmp_path / "c.mat"), ans_1=TIME, ans_2=DRIVE, ans_3=PLACE)


@pytest.mark.parametrize("version", ["5", "4"])
def test_plain_arrays(version: str, tmp_path: Path):
    savemat(tmp_path / "a.mat", {"t": TIME, "u": DRIVE, "slow": np.arange(7.0), "fs": 1e4}, format=version)
    table = read_in_process(tmp_path / "a.mat")
    assert has_columns(table, t=TIME, u=DRIVE)
    assert table.about["other groups"] == "'7 rows' (7 rows, 1 column)"


def test_matlab_73(tmp_path: Path):
    """MATLAB stores arrays transposed, and structure arrays and cells as references."""
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        file["t"], file["both"] = TIME[:, None], np.stack([DRIVE, PLACE])
        cells = file.create_group("#refs#")
        signals = file.create_group("s")
        for field, values in {"values": (DRIVE, PLACE), "label": ("drive", "place")}.items():
            places = signals.create_dataset(field, (2, 1), h5py.ref_dtype)
            for k, value in enumerate(values):
                data = np.array([[ord(letter)] for letter in value], "u2") if isinstance(value, str) else value[None]
                cells[f"{field}{k}"] = data
                cells[f"{field}{k}"].attrs["MATLAB_class"] = np.bytes_("char" if isinstance(value, str) else "double")
                places[k, 0] = cells[f"{field}{k}"].ref
    with (tmp_path / "a.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    table = read_in_process(tmp_path / "a.mat")
    assert table.columns.keys() == {"t", "both_1", "both_2", "s/1/values", "s/2/values"}
    assert table.columns["both_2"].tobytes() == table.columns["s/2/values"].tobytes() == PLACE.tobytes()
    assert table.time == "t"


def test_a_named_type_in_a_matlab_file_is_passed_over(tmp_path: Path):
    """A named type is an object without values; HDF5 stores it beside the arrays."""
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        file["t"], file["u"], file["kind"] = TIME[None], DRIVE[None], np.dtype("f8")
    with (tmp_path / "a.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    assert has_columns(read_in_process(tmp_path / "a.mat"), t=TIME, u=DRIVE)


def test_a_reference_to_itself_ends(tmp_path: Path):
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        cell = file.create_dataset("cell", (1, 1), h5py.ref_dtype)
        cell[0, 0] = cell.ref
    with (tmp_path / "a.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    with pytest.raises(UnreadableData, match="a reference to itself"):
        read_in_process(tmp_path / "a.mat")


def test_hdf5_in_groups_with_links_that_lead_back(tmp_path: Path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["run/1/time"], file["run/1/u"] = TIME, DRIVE
        file["run/1/u"].attrs["unit"] = "V"
        file["run/2/time"], file["run/2/u"] = TIME, PLACE
        file["loop"], file["run/back"], file["self"] = file["/"], h5py.SoftLink("/run"), h5py.SoftLink("/self")
        file["text"], file["steps"] = "words", np.zeros(9, "i2")
    table = read_in_process(tmp_path / "a.h5")
    assert has_columns(table, time=TIME, u=DRIVE)
    assert table.units == {"u": "V"}
    assert table.about["left out"] == (
        "loop (a link to an object that is already included), run/back (a link to an object that is already "
        "included), "
        "self (a link without a target)"
    )
    assert has_columns(read_in_process(tmp_path / "a.h5", Hints("run/2")), time=TIME, u=PLACE)


def test_hdf5_of_nothing_but_a_loop(tmp_path: Path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["a/b"] = file.create_group("c")
        file["c/d"] = file["a"]
    with pytest.raises(UnreadableData, match="contains no column with two or more numbers"):
        read_in_process(tmp_path / "a.h5")


def test_numpy_and_pandas(tmp_path: Path):
    records = np.zeros(500, [("t", "f8"), ("n", "i4")])
    records["t"], records["n"] = TIME, np.arange(500)
    np.savez(tmp_path / "a.npz", log=records, pickled=np.array([{}], object))
    table = read_in_process(tmp_path / "a.npz")
    assert has_columns(table, t=TIME, n=np.arange(500))
    assert table.about["left out"] == "pickled (pickled objects)"
    times = pandas.date_range("2024-03-01", periods=500, freq="100us", name="when")
    pandas.DataFrame({"u": DRIVE, "note": "a"}, index=times).to_parquet(tmp_path / "a.parquet")
    table = read_in_process(tmp_path / "a.parquet")
    assert (table.time, table.about["left out"].split()[0]) == ("when", "note")
    assert np.allclose(table.columns["when"], TIME, atol=1e-12)
    assert table.columns["u"].tobytes() == DRIVE.tobytes()
