"""MAT files: v5 and older by scipy, v7.3 by h5py; the layouts of ControlDesk and Simulink, structures and plain arrays.

ControlDesk writes one structure: X, the times of each raster, and Y(k), a signal each, with Name, Data, Unit and the
XIndex of its raster. Simulink's structure with time has time and signals(k) with values and label; its To File block
writes a matrix whose first row is the time. Objects (timeseries, Dataset, table) are readable for MATLAB alone.
"""

from __future__ import annotations

import os
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, TypeGuard

import numpy as np

from rtloop.foundation.trusted import open_user_file
from rtloop.interchange.formats.groups import MAX_BYTES, FileColumns, select_table, unique_name
from rtloop.interchange.formats.hdf5 import matlab_variables
from rtloop.interchange.formats.table import Table, UnreadableData

HEADER_BYTES = 128
MATRIX, COMPRESSED = 14, 15
"""Types of the elements of a file (MathWorks, MAT-File Format, table 1-1)."""
BLOCK = 1 << 16
MAX_DEPTH = 32
HDF5_OFFSET = 512
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
VALUE_KEYS = ("data", "values")


def read_mat(path: Path, group: str | None = None) -> Table:
    """Return the signals of the raster or structure `group`.

    For None, it is the longest group with several columns, or else the longest one. Raises UnreadableData if the file
    is no MAT file, damaged or too large, or has no such group or no numbers; MissingExtra without h5py for version 7.3.
    """
    with os.fdopen(open_user_file(path), "rb") as file:
        head = file.read(HDF5_OFFSET + len(HDF5_MAGIC))
    columns = FileColumns(path)
    variables = matlab_variables(columns) if head[HDF5_OFFSET:] == HDF5_MAGIC else _load_variables(path, head)
    tables: dict[str, Table] = {}
    for name, value in variables.items():
        if _is_controldesk(value):
            for raster, table in _controldesk_tables(path, value).items():
                tables[unique_name(raster or name, tables)] = table
        else:
            _collect_arrays(columns, name, value, 0)
    grouped = {name: _with_first_row(table, columns) for name, table in columns.grouped_tables().items()}
    return select_table(path, tables | grouped, group, columns.in_other_files)


def _with_first_row(table: Table, columns: FileColumns) -> Table:
    """Return a table whose times are the first row of a matrix, if it grows, as Simulink's To File writes it."""
    name = next(iter(table.columns))
    is_first = name in columns.row_wise and len(table.columns) > 1 and bool(np.all(np.diff(table.columns[name]) > 0))
    if not is_first or table.time is not None:
        return table
    note = f"the first row, {name}, counts as the time in s, as Simulink's To File writes it"
    return replace(table, time=name, units={name: "s", **table.units}, notes=(*table.notes, note))


def _load_variables(path: Path, head: bytes) -> dict[str, object]:
    """Return the variables of a file of version 5 or older by name, structures as dicts.

    `head` has the first bytes of the file, at least HEADER_BYTES, which tell the version. Raises UnreadableData if the
    file is no MAT file, damaged, or larger than MAX_BYTES when unpacked; OSError if it cannot be opened.
    """
    from scipy.io import loadmat

    if head[124:128] in (b"\x00\x01IM", b"\x01\x00MI"):
        _require_bounded_size(path, "<" if head[126:128] == b"IM" else ">")
    elif path.stat().st_size > MAX_BYTES or not any(head[:20]):
        raise UnreadableData(f"{path}: not a MAT file, or one of version 4 with more than {MAX_BYTES >> 30} GiB")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with os.fdopen(open_user_file(path), "rb") as file:
                variables = loadmat(file, simplify_cells=True)
    except Exception as fault:  # scipy lets through whatever a damaged element leads to
        raise UnreadableData(f"{path}: not a MAT file, or damaged ({_first_line(fault)})") from None
    return {name: value for name, value in variables.items() if not name.startswith("__")}


def _require_bounded_size(path: Path, order: str) -> None:
    """Raise UnreadableData if an element of a MAT file is damaged or cut off, or all unpacked exceed MAX_BYTES.

    `order` is the file's byte order, "<" or ">".
    """
    size, position, total = path.stat().st_size, HEADER_BYTES, 0
    with os.fdopen(open_user_file(path), "rb") as file:
        while position < size:
            file.seek(position)
            kind, length = np.frombuffer(file.read(8).ljust(8, b"\0"), f"{order}u4").tolist()
            if kind not in (MATRIX, COMPRESSED):
                raise UnreadableData(
                    f"{path}: damaged: no element of a MAT file at byte {position}; copy or save the file again"
                )
            if position + 8 + length > size:
                raise UnreadableData(
                    f"{path}: cut off: the element at byte {position} ends beyond the end of the file; copy or save "
                    "the file again"
                )
            total += length if kind == MATRIX else _decompressed_size(path, file, length, MAX_BYTES - total)
            if total > MAX_BYTES:
                raise UnreadableData(
                    f"{path}: contains more than {MAX_BYTES >> 30} GiB; split the file with the program that wrote it"
                )
            position += 8 + length


def _decompressed_size(path: Path, file: IO[bytes], length: int, limit: int) -> int:
    """Return the decompressed size in bytes of an element of `length` bytes at the current position of `file`.

    Counting ends beyond `limit`: a result above it is a lower bound of the size. Raises UnreadableData if the element
    is damaged.
    """
    stream, total, remaining = zlib.decompressobj(), 0, length
    try:
        while (remaining or stream.unconsumed_tail) and not stream.eof and total <= limit:
            block = stream.unconsumed_tail or file.read(min(remaining, BLOCK))
            remaining -= 0 if stream.unconsumed_tail else len(block)
            total += len(stream.decompress(block, BLOCK * 16))
    except zlib.error as fault:
        raise UnreadableData(f"{path}: damaged: {fault}") from None
    return total


def _is_controldesk(value: object) -> TypeGuard[Mapping[str, object]]:
    """Whether `value` is a structure of ControlDesk: X and Y(k), each with Data."""
    if not isinstance(value, dict) or not {"X", "Y"} <= value.keys():
        return False
    return all(
        isinstance(structure, dict) and "Data" in structure for key in "XY" for structure in _as_list(value[key])
    )


def _controldesk_tables(path: Path, value: Mapping[str, object]) -> dict[str, Table]:
    """Return a table for each X, the times of a raster, that has columns.

    The key is the raster's name, such as "X(2)" for the second X if it names no raster, and "" if there is one X alone.
    A signal Y belongs to each X of equal length, unless its XIndex or its Raster names another one.
    """
    times, tables = _as_list(value["X"]), dict[str, Table]()
    about = {"layout": "ControlDesk", **_description(value)}
    for number, x in enumerate(times, start=1):
        columns = FileColumns(path)
        name = unique_name(_as_text(x.get("Name")) or "Time", ())
        columns.add_column(name, x["Data"], _as_text(x.get("Unit")) or "s")
        rows = np.size(x["Data"])
        for y in _as_list(value["Y"]):
            if _raster_index(y) in (None, number) and np.size(y["Data"]) == rows and _rasters_agree(y, x):
                label = _as_text(y.get("Name")) or "Y"
                columns.add_column(unique_name(label, columns.columns), y["Data"], _as_text(y.get("Unit")))
        raster = _as_text(x.get("Raster")) if len(times) > 1 else ""
        if columns.columns:
            tables[unique_name(raster or (f"X({number})" if len(times) > 1 else ""), tables)] = Table(
                columns.columns, columns.units, name, about
            )
    return tables


def _rasters_agree(y: Mapping[str, object], x: Mapping[str, object]) -> bool:
    """Whether signal `y` and time `x` name the same raster; True also where either names none."""
    y_raster, x_raster = _as_text(y.get("Raster")), _as_text(x.get("Raster"))
    return not y_raster or not x_raster or y_raster == x_raster


def _raster_index(y: dict[str, Any]) -> int | None:
    """Return the number of a signal's X, from 1; None without one."""
    number = y.get("XIndex", y.get("Xindex"))
    return int(number) if number is not None and np.size(number) == 1 else None


def _description(value: Mapping[str, object]) -> dict[str, str]:
    """Return {"description": text}, at most 200 characters, of a structure of ControlDesk; {} without one."""
    text = value.get("Description")
    text = next((entry for entry in text.values() if isinstance(entry, str)), "") if isinstance(text, dict) else text
    return {"description": text[:200]} if isinstance(text, str) and text else {}


def _collect_arrays(columns: FileColumns, path: str, value: object, depth: int, unit: str | None = None) -> None:
    """Add every array of numbers in `value` to `columns`, by its path.

    A structure's fields Name and Unit, its own or in its DataInfo, are name and unit of its field Data or Values.
    `unit` is the unit of `value` if it is an array itself; `depth` is the number of levels above it. Objects that only
    MATLAB can read are listed as left out. Raises UnreadableData for structures that are nested too deeply.
    """
    if depth > MAX_DEPTH:
        raise UnreadableData(f"{columns.path}: {path}: nested too deeply; allowed: up to {MAX_DEPTH} levels")
    if isinstance(value, dict):
        info = value.get("DataInfo")
        properties = {
            key.casefold(): item for key, item in {**(info if isinstance(info, dict) else {}), **value}.items()
        }
        unit, name = (
            _as_text(properties.get("unit")) or _as_text(properties.get("units")),
            _as_text(properties.get("name")),
        )
        for key, element in value.items():
            if key == "signals":
                _collect_signals(columns, path, element, depth)
            elif key.casefold() in VALUE_KEYS:
                _collect_arrays(columns, f"{path}/{name or key}", element, depth + 1, unit)
            else:
                _collect_arrays(columns, f"{path}/{key}", element, depth + 1)
    elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype.kind == "O"):
        for number, element in enumerate(_as_list(value), start=1):
            name = _as_text(element.get("Name", element.get("name"))) if isinstance(element, dict) else ""
            _collect_arrays(columns, f"{path}/{name or number}", element, depth + 1)
    elif type(value).__name__ in ("MatlabOpaque", "MatlabFunction"):
        columns.left_out.append(f"{path} (an object that only MATLAB can read; save a structure or an array instead)")
    elif isinstance(value, np.ndarray | float | int):
        columns.add_column(path, value, unit)


def _collect_signals(columns: FileColumns, path: str, signals: object, depth: int) -> None:
    """Add Simulink's signals(k) to `columns`: `values` under the signal's label, title or block name.

    A signal without `values` is added like any structure. If `values` has three or more dimensions, the last one is
    the time.
    """
    for number, signal in enumerate(_as_list(signals), start=1):
        if isinstance(signal, dict) and "values" in signal:
            values = np.asarray(signal["values"])
            if values.ndim > 2:
                values = values.reshape(-1, values.shape[-1])
            label = (
                _as_text(signal.get("label"))
                or _as_text(signal.get("title"))
                or _as_text(signal.get("blockName"))
                or f"signal_{number}"
            )
            columns.add_column(unique_name(f"{path}/{label.replace('/', '.')}", columns.columns), values)
        else:
            _collect_arrays(columns, f"{path}/signals/{number}", signal, depth + 1)


def _as_list(value: object) -> list[Any]:
    """Return a structure as a list of one, or the elements of a list or array of structures; [] for other values."""
    if isinstance(value, dict):
        return [value]
    return list(value.ravel()) if isinstance(value, np.ndarray) else list(value) if isinstance(value, list) else []


def _as_text(value: object) -> str:
    """Return stripped text, or empty text for other values."""
    return value.strip() if isinstance(value, str) else ""


def _first_line(fault: Exception) -> str:
    """Return the first line of an error's message, or its class's name without a message."""
    return (str(fault).strip().splitlines() or [type(fault).__name__])[0][:200]
