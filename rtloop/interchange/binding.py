"""Evidence bound to one reading: columns, units, missing values and the clock of a table, once for all who ask."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.interchange.columns import ColumnSelection
from rtloop.interchange.formats.cells import NO_MARKER, parse_cell
from rtloop.interchange.formats.table import AmbiguousData, Reading, Table, UnreadableData, ask
from rtloop.interchange.mapping import column_unit, default_signal_name, map_column, require_one_unit
from rtloop.interchange.sampling import (
    RECORDING_TIME_COLUMNS,
    TimeBase,
    clock_column,
    find_time_base,
    is_from_recording,
)
from rtloop.values import count_text

SCPI_MISSING = (9.9e37, 9.91e37)
"""SCPI's infinity and not-a-number (SCPI 1999, volume 1, 7.2.1.4 and 7.2.1.5), of either sign."""
_SINCE = re.compile(r"(\S+)\s+since\s+.+", re.DOTALL)
"""Unit of the CF conventions: seconds since 2024-03-04 12:00:00."""
_SECONDS = re.compile(r"(.*?)[._/ ]?(secs?|tv_sec|seconds?)", re.IGNORECASE)
_MICROSECONDS = ("tv_usec", "usec", "usecs", "microsecond", "microseconds")
_FRACTION = re.compile(
    rf"(.*?)[._/ ]?(nsecs?|nanosecs?|nanoseconds?|nanos|tv_nsec|{'|'.join(_MICROSECONDS)})", re.IGNORECASE
)
_MARKER = re.compile(
    r"10{6,}|9{3,}\.?9*|99\.9+|32767|32768|65535|2147483647|2147483648|1e\+?\d\d\d?|3\.40282\d*e\+38|1\.79769\d*e\+308"
)
MARKER_RATIO = 5.0
"""A value beyond all others by this factor is suspected to mark missing ones, if it looks like a marker."""
FEWEST_TO_SUSPECT = 10


class Binding(NamedTuple):
    """A table as it is read: `units` of all columns, the times or the `fault` why there are none, and notes."""

    path: Path
    table: Table
    units: Mapping[str, str | None]
    clock: str | None
    time_columns: frozenset[str]
    time_base: TimeBase | None
    fault: UnreadableData | None
    notes: list[str]

    def require_time(self) -> TimeBase:
        """Return the times. Raises UnreadableData without any."""
        if self.time_base is None:
            raise self.fault or UnreadableData(f"{self.path}: no times")
        return self.time_base


def bind(table: Table, path: Path, selection: ColumnSelection) -> Binding:
    """Return the reading of a table, by its evidence and the answers in `selection`.

    Raises AmbiguousData where two readings remain, UnreadableData for an unknown column of `selection`.
    """
    notes = [*table.notes]
    if not is_from_recording(table):
        table = _join_seconds(table, selection.clock, notes)
        table = replace(table, units={name: _SINCE.sub(r"\1", unit) for name, unit in table.units.items()})
        table = replace(table, columns=_mark_missing(table, path, selection, notes))
    units = {name: column_unit(table, name) for name in table.columns}
    clock = clock_column(table, path, selection, units)
    if clock is not None and selection.time_unit is None and selection.time is None and selection.rate_hz is None:
        require_one_unit(table, path, clock, "")
    for name in () if selection.signals or is_from_recording(table) else table.columns:
        if name != clock:
            require_one_unit(table, path, name, default_signal_name(name))
    if clock is not None:
        table = _without_empty_rows(table, clock, notes)
    time_base, fault = None, None
    try:
        time_base = find_time_base(table, path, selection, units, clock)
    except AmbiguousData:
        raise
    except UnreadableData as error:
        fault = error
    given = None if selection.time is None else map_column(table, path, "time", selection.time).name
    time_columns = {clock, given} | ({*RECORDING_TIME_COLUMNS, table.time} if is_from_recording(table) else set())
    notes += [
        f"{name}: counted from {origin}, its first value: doubles hold whole numbers up to 2**53 alone"
        for name, origin in table.origins.items()
        if name not in time_columns
    ]
    return Binding(path, table, units, clock, frozenset(filter(None, time_columns)), time_base, fault, notes)


def _join_seconds(table: Table, clock: str | None, notes: list[str]) -> Table:
    """Return the table with one column of times in s for seconds and a fraction in a second column, as ROS has them.

    A header's stamp is the time of the measurement, and thereby the table's, if it grows.
    """
    for name, seconds in table.columns.items():
        whole = _SECONDS.fullmatch(name)
        parts = [(key, part) for key in table.columns if (part := _FRACTION.fullmatch(key))]
        pair = next(((key, part) for key, part in parts if whole and part[1] == whole[1]), None)
        if whole is None or pair is None:
            continue
        joined, (other, part) = whole[1].rstrip("._/ ") or "time", pair
        values = seconds - seconds[:1] + table.columns[other] * (1e-6 if part[2].lower() in _MICROSECONDS else 1e-9)
        if not np.all(np.diff(values) > 0) or joined in table.columns:
            continue
        notes.append(f"{joined}: {name} and {other} together")
        if table.time is not None and clock is None:
            notes.append(f"the times are {joined}, of the measurement; --clock {table.time} for those of the log")
        renamed = {joined if key == name else key: column for key, column in table.columns.items() if key != other}
        origins = {**table.origins, joined: table.origins.get(name, 0) + int(seconds[0])}
        units = {**table.units, joined: "s"}
        return replace(table, columns=renamed | {joined: values}, units=units, time=joined, origins=origins)
    return table


def _mark_missing(table: Table, path: Path, selection: ColumnSelection, notes: list[str]) -> dict[str, Real]:
    """Return the columns with NaN for the numbers that mean none: those of `selection`, and SCPI's.

    Raises AmbiguousData for a column with a value that may be such a number.
    """
    cells = [parse_cell(text, ".") for text in selection.missing]
    given = [cell.value for cell in cells if cell is not None and np.isfinite(cell.value)]
    columns = {}
    for name, values in table.columns.items():
        numbers = {*given, *(sign * value for value in SCPI_MISSING for sign in (1, -1))}
        numbers |= {float(np.float32(value)) for value in numbers}
        is_marker = np.isin(values, [*numbers])
        if is_marker.any():
            listed = ", ".join(f"{value:g}" for value in sorted({*values[is_marker].tolist()}))
            notes.append(f"{name}: {count_text(int(is_marker.sum()), 'value')} missing: {listed}")
            values = np.where(is_marker, np.nan, values)
        if NO_MARKER not in selection.missing and (suspect := _suspicious(values)) is not None:
            count = int(np.count_nonzero(values == suspect))
            raise ask(
                path,
                f"column {name!r} holds {suspect:.12g} {count_text(count, 'time')}, far from all other values",
                Reading(f"--missing {suspect:.12g}", "it marks a missing value"),
                Reading(f"--missing {NO_MARKER}", "it is a value"),
            )
        columns[name] = values
    return columns


def _suspicious(values: Real) -> float | None:
    """Return a value that may mark missing ones: ±99.99, -32768 or 1e30, far from all others; None without one."""
    finite = values[np.isfinite(values)]
    if finite.size < FEWEST_TO_SUSPECT:
        return None
    for extreme in (float(finite.max()), float(finite.min())):
        rest = finite[finite != extreme]
        looks = _MARKER.fullmatch(f"{abs(extreme):.15g}")
        if looks and rest.size >= FEWEST_TO_SUSPECT and abs(extreme) > MARKER_RATIO * float(np.abs(rest).max()) > 0:
            return extreme
    return None


def _without_empty_rows(table: Table, clock: str, notes: list[str]) -> Table:
    """Return the table without the rows that have no value at all; a note counts them."""
    if not np.isnan(table.columns[clock]).any():
        return table
    is_empty = np.all([np.isnan(values) for values in table.columns.values()], axis=0)
    if not is_empty.any():
        return table
    notes.append(f"{count_text(int(is_empty.sum()), 'row')} without any value left out")
    return replace(table, columns={name: values[~is_empty] for name, values in table.columns.items()})
