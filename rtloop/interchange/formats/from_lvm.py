"""LabVIEW's measurement file (.lvm), by its own header: separator, decimal sign, columns of times, segments.

A segment has a header of keys, the line of names, and its rows. X_Columns says whether the times stand in one column
(One), in one for each channel (Multi), or in none (No): then X0 and Delta_X give them.
"""

from __future__ import annotations

import re
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.interchange.formats.cells import is_missing, parse_cell
from rtloop.interchange.formats.groups import select_table, unique_name
from rtloop.interchange.formats.table import Hints, Table, UnreadableData
from rtloop.interchange.formats.text_source import TextSource, split_fields
from rtloop.values import count_text

_END = "***End_of_Header***"
_DELIMITERS = {"tab": "\t", "comma": ",", "semicolon": ";"}


def is_labview(head: bytes) -> bool:
    """Whether a file begins as LabVIEW's measurement file does."""
    return head.lstrip(b"\xef\xbb\xbf").startswith(b"LabVIEW Measurement")


def read_lvm(path: Path, hints: Hints) -> Table:
    """Return the channels of a group; all segments with the same channels one after the other.

    Raises UnreadableData for a damaged row, with its line, or a file without rows.
    """
    with closing(TextSource(path)) as source:
        return _read(path, source, hints)


def _read(path: Path, source: TextSource, hints: Hints) -> Table:
    settings: dict[str, list[str]] = {}
    segment: dict[str, list[str]] = {}
    tables: dict[str, Table] = {}
    names: list[str] = []
    rows: list[list[float]] = []
    delimiter, decimal, state = "\t", ".", "settings"
    markers: list[str] = []
    comments = 0

    def finish() -> None:
        """Add the rows of the segment to the tables."""
        if rows:
            for name, table in _segment_tables(path, settings, segment, names, rows).items():
                _append(tables, name, table)
        rows.clear()

    for number, line in source.lines(0, skip=hints.skip_rows).numbered():
        fields = split_fields(line, delimiter)
        key = fields[0] if fields else ""
        if state == "settings":
            if key.lower() == "separator" and len(fields) > 1:
                delimiter = _DELIMITERS.get(fields[1].lower(), "\t")
            elif key.lower().startswith("separator"):
                delimiter = next((d for name, d in _DELIMITERS.items() if name in key.lower()), delimiter)
            if key.startswith(_END):
                state, decimal = "segment", "," if settings.get("Decimal_Separator") == [","] else "."
            elif len(fields) > 1:
                settings[key] = [field for field in fields[1:] if field]
        elif key in ("Channels", "***Start_Special***") or (state == "rows" and key.startswith(_END)):
            finish()
            segment, state = {key: fields[1:]}, "segment" if key == "Channels" else "special"
        elif state == "special":
            state = "segment" if key.startswith("***End_Special***") else state
        elif key.startswith(_END):
            state = "names"
        elif state == "segment" and fields:
            segment[key] = fields[1:]
        elif state == "names" and fields:
            names, state = fields, "rows"
        elif state == "rows" and any(fields):
            width = len(names) - (names[-1:] == ["Comment"])
            cells = [*fields, *[""] * width][:width]
            comments += len(names) > width and any(fields[width:])
            values = [parse_cell(cell, decimal) for cell in cells]
            bad = next(
                (c for c, v in zip(cells, values, strict=True) if v is None and not is_missing(c, hints.missing)), None
            )
            if bad is not None:
                raise UnreadableData(f"{path}: {bad[:60]!r} is not a number (line {number})")
            markers += [cell for cell, value in zip(cells, values, strict=True) if value is None and cell]
            rows.append([np.nan if value is None else value.value for value in values])
    finish()
    if not tables:
        raise UnreadableData(f"{path}: a LabVIEW measurement without rows of numbers")
    left_out = [f"{comments} × Comment (text)"] if comments else []
    for name, table in tables.items():
        empty = [key for key, values in table.columns.items() if not np.isfinite(values).any()]
        left_out += [f"{key} (empty)" for key in empty]
        tables[name] = replace(table, columns={key: v for key, v in table.columns.items() if key not in empty})
    about = {"layout": f"LabVIEW measurement, X_Columns {' '.join(settings.get('X_Columns', ['One']))}"}
    notes = (f"{count_text(len(markers), 'value')} missing: {', '.join(sorted(set(markers)))}",) if markers else ()
    tables = {
        name: replace(table, about={**about, **table.about}, notes=(*table.notes, *notes))
        for name, table in tables.items()
    }
    return select_table(path, tables, hints.group)


def _segment_tables(
    path: Path, settings: dict[str, list[str]], segment: dict[str, list[str]], names: list[str], rows: list[list[float]]
) -> dict[str, Table]:
    """Return the tables of a segment by name: one, or one for each channel with its own times."""
    data: Real = np.array(rows)
    kind = settings.get("X_Columns", ["One"])[0]
    heads = names[: data.shape[1]]
    places = [k for k, name in enumerate(heads) if not (kind != "No" and re.fullmatch(r"X_Value(\s*\d*)?", name))]
    if kind == "No" and heads and heads[0] == "X_Value":
        places = places[1:]
    labels = segment.get("Y_Unit_Label", [])
    labels = labels if len(labels) <= len(places) else [label for label in labels if label]
    units = [*labels, *[""] * len(places)][: len(places)]
    columns = {}
    for place in places:
        columns[unique_name(heads[place] or f"column_{place + 1}", columns)] = np.ascontiguousarray(data[:, place])
    by_name = {name: unit for name, unit in zip(columns, units, strict=True) if unit}
    if kind == "Multi":
        return _own_clocks(data, heads, places, columns, by_name)
    if kind == "One" and 0 not in places:
        clock = {"X_Value": np.ascontiguousarray(data[:, 0])}
        return {"all": Table(clock | columns, {"X_Value": "s"} | by_name, "X_Value")}
    steps = [
        cell.value
        for text in segment.get("Delta_X", [])
        if (cell := parse_cell(text, ".")) or (cell := parse_cell(text, ","))
    ]
    starts = [
        cell.value
        for text in segment.get("X0", [])
        if (cell := parse_cell(text, ".")) or (cell := parse_cell(text, ","))
    ]
    tables: dict[str, Table] = {}
    for step in dict.fromkeys(steps):
        own = [name for name, other in zip(columns, steps, strict=False) if other == step]
        lengths = {name: int(np.isfinite(columns[name]).nonzero()[0].max(initial=-1)) + 1 for name in own}
        length = max(lengths.values())
        times: Real = (starts[0] if starts else 0.0) + step * np.arange(length, dtype=np.float64)
        tables[f"Delta_X {step:g}"] = Table(
            {"X_Value": times, **{name: columns[name][:length] for name in own}},
            {"X_Value": "s", **{name: by_name[name] for name in own if name in by_name}},
            "X_Value",
            notes=(f"the times are X0 {starts[0] if starts else 0:g} s and Delta_X {step:g} s, as the file states",),
        )
    return tables or {"all": Table(columns, by_name)}


def _own_clocks(
    data: Real, heads: list[str], places: list[int], columns: dict[str, Real], units: dict[str, str]
) -> dict[str, Table]:
    """Return a table for each distinct column of times, with the channels behind it."""
    tables: dict[str, Table] = {}
    clocks: list[tuple[Real, str]] = []
    for name, place in zip(columns, places, strict=True):
        times = data[:, max(k for k in range(place) if k not in places)]
        rows = int(np.isfinite(times).sum())
        group = next((label for known, label in clocks if np.array_equal(known, times[:rows])), None)
        if group is None:
            group = f"X_Value of {name}"
            clocks.append((np.ascontiguousarray(times[:rows]), group))
            tables[group] = Table({"X_Value": clocks[-1][0]}, {"X_Value": "s"}, "X_Value")
        old = tables[group]
        tables[group] = replace(
            old,
            columns={**old.columns, name: np.ascontiguousarray(columns[name][:rows])},
            units={**old.units, **({name: units[name]} if name in units else {})},
        )
    return tables


def _append(tables: dict[str, Table], name: str, table: Table) -> None:
    """Add a segment to the tables: behind the one with the same columns if its times go on, else as a group."""
    old = tables.get(name)
    is_equal = old is not None and old.columns.keys() == table.columns.keys()
    if old is not None and is_equal and old.time and table.columns[old.time][0] > old.columns[old.time][-1]:
        joined = {key: np.concatenate([old.columns[key], table.columns[key]]) for key in old.columns}
        tables[name] = replace(old, columns=joined)
        return
    tables[unique_name(name, tables)] = table
