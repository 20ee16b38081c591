"""Groups of columns sampled together: the rasters of a recorder, the groups of a file, arrays of one length."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.interchange.formats.stated import parameters, scale_statements, stated_rates, stated_ticks
from rtloop.interchange.formats.table import MAX_ROWS, Table, UnreadableData
from rtloop.interchange.names import TIME_NAMES, bare_name, is_time_name
from rtloop.values import count_text

MAX_BYTES = 1 << 30
"""Limit for the numbers of a file in memory."""
MAX_COLUMNS = 2000
MATRIX_COLUMNS = 256
"""A matrix with more columns counts as an image or a map, and not as a table of signals."""
MAX_SHOWN_NAMES = 8


@dataclass
class FileColumns:
    """All columns found in a file, before grouping, by their path, with their units.

    `left_out` and `in_other_files` name columns that are not read; the latter because the file only points to them.
    `bytes` is the memory that `require_room` has counted. `single` are single numbers by path, which may state a sample
    rate. `origins`, `made_up` (columns of matrices; `row_wise` those that were first rows) and `notes` go into the
    tables: see Table.
    """

    path: Path
    columns: dict[str, Real] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    in_other_files: list[str] = field(default_factory=list)
    bytes: int = 0
    single: dict[str, object] = field(default_factory=dict)
    origins: dict[str, int] = field(default_factory=dict)
    made_up: set[str] = field(default_factory=set)
    row_wise: set[str] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)

    def require_room(self, name: str, shape: tuple[int, ...]) -> None:
        """Add the size of an array of doubles of `shape` to `bytes`.

        Raises UnreadableData if `bytes` exceeds MAX_BYTES, or the longest side of this array MAX_ROWS.
        """
        rows, size = max(shape, default=1), 8 * int(np.prod(shape, dtype=object))
        self.bytes += size
        if rows > MAX_ROWS or self.bytes > MAX_BYTES:
            raise UnreadableData(
                f"{self.path}: {name}: the file's numbers take more than {MAX_BYTES >> 30} GiB of memory; split "
                "the file with the program that wrote it, or write fewer signals"
            )

    def add_column(self, name: str, values: npt.ArrayLike, unit: str | None = None) -> None:
        """Add one column as float64, or each column of a matrix, whose longer side is the time, as NAME_1, NAME_2, ….

        A name that exists already gets a number in brackets. Single values are ignored; arrays of text, matrices with
        more than MATRIX_COLUMNS columns and arrays of more dimensions are listed in `left_out`. Raises UnreadableData
        if the file has more than MAX_COLUMNS columns.
        """
        array = np.asarray(values)
        if array.dtype.kind == "M" and array.ndim == 1 and array.size > 1:
            ns = array.astype("datetime64[ns]").astype(np.int64)
            array, unit = (ns - ns[0]) * 1e-9, "s"
        if array.dtype.kind not in "fiub":
            if array.size > 1 or array.dtype.kind != "U":
                self.left_out.append(f"{name} ({_kind_description(array)})")
            return
        array = np.squeeze(array) if array.ndim > 1 else array
        if array.ndim == 2 and min(array.shape) <= MATRIX_COLUMNS:
            is_row_wise = array.shape[0] < array.shape[1]
            if is_row_wise:
                self.row_wise.add(f"{name}_1")
            for number, column in enumerate(array if is_row_wise else array.T, start=1):
                self.add_column(f"{name}_{number}", column, unit)
                self.made_up.add(f"{name}_{number}")
        elif array.ndim != 1 or array.size < 2:
            if array.size > 1:
                self.left_out.append(f"{name} ({'×'.join(map(str, array.shape))})")
            elif array.size == 1:
                self.single[name.removesuffix("/value")] = array.item()  # LabOne keeps a setting's value so
        elif len(self.columns) == MAX_COLUMNS:
            raise UnreadableData(f"{self.path}: too many columns; allowed: up to {MAX_COLUMNS}")
        else:
            name = unique_name(name, self.columns)
            self.columns[name], origin = exact_floats(array)
            if origin:
                self.origins[name] = origin
            if unit:
                self.units[name] = unit

    def _is_note_of(self, note: str, names: Sequence[str]) -> bool:
        """Whether a note, which may begin with a column's name, concerns one of the names, or all columns."""
        owner = note.partition(": ")[0]
        return owner in names or owner not in self.columns

    def grouped_tables(self) -> dict[str, Table]:
        """Return tables by group name: each has the columns of one length with the same nearest column of times.

        The nearest column of times has the same length and shares the most folders of its path with the column. Columns
        of a length without a column of times are one group.

        A group's name is the folder that all its columns share, which their names then lack; without one, the folder of
        the times, or else the number of rows, such as "100 rows".
        """
        times = [name for name in self.columns if is_time_name(name)]
        times.sort(key=lambda name: TIME_NAMES.index(bare_name(name)))
        members: dict[tuple[int, str | None], list[str]] = {}
        for name, values in self.columns.items():
            time_candidates = [time for time in times if self.columns[time].size == values.size]
            nearest_time = max(time_candidates, key=lambda time: _shared_depth(time, name), default=None)
            members.setdefault((values.size, nearest_time), []).append(name)
        about = {"left out": ", ".join(self.left_out[:MAX_SHOWN_NAMES])} if self.left_out else {}
        tables: dict[str, Table] = {}
        for (rows, time), names in members.items():
            begin = len(_shared_folder(names))
            short_names = {name: name[begin:] for name in names}
            statements = parameters({key: value for key, value in self.single.items() if _concerns(key, names)})
            group = _shared_folder(names).strip("/") or (time or "").rpartition("/")[0] or count_text(rows, "row")
            codes = [name for name in names if name != time and are_codes(self.columns[name])]
            scales = [entry.text for entry in scale_statements(statements)] if codes else []
            unscaled = [f"{codes[0]} holds whole numbers; {', '.join(scales)} is not applied"] if scales else []
            tables[unique_name(group, tables)] = Table(
                {short_names[name]: self.columns[name] for name in names},
                {short_names[name]: self.units[name] for name in names if name in self.units},
                None if time is None else short_names[time],
                about,
                rates=tuple((rate.hz, rate.source) for rate in stated_rates(statements)),
                tick_hz=stated_ticks(statements),
                unnamed=tuple(short_names[name] for name in names if name in self.made_up),
                origins={short_names[name]: self.origins[name] for name in names if name in self.origins},
                notes=(*unscaled, *(note for note in self.notes if self._is_note_of(note, names))),
            )
        return tables


def select_table(
    path: Path, tables: Mapping[str, Table], group: str | None, in_other_files: Sequence[str] = ()
) -> Table:
    """Return the table of `group`; for None, the longest one with several columns, or else the longest one.

    Its `about` names the other groups; `in_other_files` becomes the table's. Raises UnreadableData without a table, and
    for an unknown group.
    """
    if not tables:
        hint = (
            f"; left out because their values are in other files: {', '.join(in_other_files[:MAX_SHOWN_NAMES])}"
            if in_other_files
            else ""
        )
        raise UnreadableData(f"{path}: contains no column with two or more numbers{hint}")
    if group is not None and group not in tables:
        raise UnreadableData(f"{path}: no group {group!r}; there are {', '.join(map(repr, tables))}")
    name = (
        group
        if group is not None
        else max(tables, key=lambda key: (len(tables[key].columns) > 1, row_count(tables[key])))
    )
    other_groups = [
        f"{other_name!r} ({count_text(row_count(table), 'row')}, {count_text(len(table.columns), 'column')})"
        for other_name, table in tables.items()
        if other_name != name
    ]
    table = replace(tables[name], in_other_files=tuple(in_other_files))
    if not other_groups:
        return table
    group_notes = {
        "group": name,
        "other groups": ", ".join(other_groups[:MAX_SHOWN_NAMES]) + ", …" * (len(other_groups) > MAX_SHOWN_NAMES),
    }
    return replace(table, about={**table.about, **group_notes})


def are_codes(values: Real) -> bool:
    """Whether values are whole numbers that vary and do not count, as a converter's codes."""
    known = values[np.isfinite(values)]
    is_varied = known.size > 2 and bool(np.ptp(known) > 2) and not np.all(np.diff(known) > 0)
    return is_varied and bool(np.all(known == np.rint(known)))


def with_left_out(table: Table, left_out: Sequence[str]) -> Table:
    """Return a table that names what was left out of its file."""
    return replace(table, about={**table.about, "left out": ", ".join(left_out[:MAX_SHOWN_NAMES])})


def exact_floats(values: npt.NDArray[Any]) -> tuple[Real, int]:
    """Return values as float64, and the whole number taken from all of them: 0, unless they would not fit."""
    if values.dtype.kind in "iu" and values.size and max(abs(int(values.min())), abs(int(values.max()))) > 1 << 53:
        return (values - values[0]).view(np.int64).astype(np.float64), int(values[0])  # right for unsigned ones, too
    return np.ascontiguousarray(values, np.float64), 0


def row_count(table: Table) -> int:
    """Return the number of samples of each column; 0 without columns."""
    return next((column.size for column in table.columns.values()), 0)


def unique_name(name: str, names: Iterable[str]) -> str:
    """Return `name`, "name (2)", "name (3)" …: the first of these that `names` does not contain."""
    used_names = set(names)
    candidate, number = name, 1
    while candidate in used_names:
        number += 1
        candidate = f"{name} ({number})"
    return candidate


def _concerns(path: str, names: Iterable[str]) -> bool:
    """Whether a single number belongs to one of the columns, to a folder of one, or to the whole file."""
    owner = path.rpartition("/")[0]
    return not owner or any(name == owner or name.startswith(f"{owner}/") for name in names)


def _shared_folder(names: Sequence[str]) -> str:
    """Return the folder that all paths begin with, with its slash; empty without one."""
    folders = [name.split("/")[:-1] for name in names]
    shared_parts = takewhile(lambda parts: len(set(parts)) == 1, zip(*folders, strict=False))
    return "".join(f"{parts[0]}/" for parts in shared_parts)


def _shared_depth(first_path: str, second_path: str) -> int:
    """Return the number of folders that two paths share."""
    depth = 0
    for first, second in zip(first_path.split("/")[:-1], second_path.split("/")[:-1], strict=False):
        if first != second:
            break
        depth += 1
    return depth


def _kind_description(array: npt.NDArray[np.generic]) -> str:
    """Return the kind of an array that holds no numbers, as text."""
    return {"U": "text", "S": "text", "O": "text or cells", "c": "complex", "M": "dates"}.get(
        array.dtype.kind, "no numbers"
    )
