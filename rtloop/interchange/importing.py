"""Import of another program's measurement as a recording: signals and their times, without a law.

Times are kept with their jitter; irregularities are reported, and noted in the recording's header.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.foundation.trusted import open_user_file
from rtloop.interchange.binding import Binding, bind
from rtloop.interchange.columns import NAME, ColumnSelection
from rtloop.interchange.formats.groups import row_count
from rtloop.interchange.formats.table import Table, UnreadableData
from rtloop.interchange.isolated_reader import read_table
from rtloop.interchange.mapping import (
    MappedColumn,
    axis_names,
    default_signal_name,
    find_column,
    map_column,
    require_one_unit,
    signal_name,
)
from rtloop.interchange.names import name_without_unit
from rtloop.interchange.sampling import RECORDING_TIME_COLUMNS, TimeBase, grows_evenly, is_from_recording
from rtloop.recording.columns import signal_unit
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.events import FINISHED, recorder_event
from rtloop.recording.file.topics.ticks import INTEGER_COLUMNS, integer_problem
from rtloop.recording.file.writer import Writer
from rtloop.version import __version__

UNFINISHED_SUFFIX = ".importing"
MAX_TEXT_CHARACTERS = 200
OUTER_ROWS = 2
"""First and last rows that are reported as they were read."""

ReportTicks = Callable[[int], None]


class ImportedSignals(NamedTuple):
    """Content of a recording: `columns` (rows,) by name, tick and deadline first.

    `mapping` (as text) and `units` are by signal, without tick and deadline; `notes` are sentences for the user.
    """

    columns: dict[str, Real]
    mapping: dict[str, str]
    units: dict[str, str]
    notes: list[str]


def import_data(
    path: Path,
    selection: ColumnSelection,
    output: Path | None = None,
    *,
    table: Table | None = None,
    progress: ReportTicks | None = None,
) -> dict[str, object]:
    """Write the selected columns of a file, all where none is selected, as the recording `output`.

    `output` is by default NAME.mcap beside the file, NAME.imported.mcap for a file NAME.mcap. `table` is the file's
    content, if it was read already; `progress` receives the number of ticks written. Returns {file, output, ticks,
    rate_hz, duration_s, time, signals, notes, about, in_other_files}; `time` is a text on the source of the times;
    `signals` are {name, unit, from, least, largest}, `from` being the mapping as text; `about` has texts about the file
    by topic, `in_other_files` names data that the file only points to.

    Raises UnreadableData if the file cannot be read, or a column, its unit or the time does not fit; MissingExtra if
    the format's package is missing; OutputError if the output exists or cannot be written; OSError if the file
    disappears meanwhile. An incomplete output is removed.
    """
    binding = bind(read_table(path, selection.hints) if table is None else table, path, selection)
    signals, time_base = _select_signals(binding, selection), binding.require_time()
    output = output or path.with_name(f"{path.stem}{'.imported' if path.suffix == '.mcap' else ''}.mcap")
    header = _make_header(path, signals, time_base, selection.position_first)
    _write_recording(output, header, signals, time_base.rate_hz, progress or (lambda _: None))
    shown = {name: signals.columns[name] for name in signals.units}
    return {
        "file": str(path),
        "output": str(output),
        "ticks": len(time_base.deadline_ns),
        "rate_hz": time_base.rate_hz,
        "duration_s": float(np.ptp(time_base.deadline_ns)) * 1e-9 + 1 / time_base.rate_hz,
        "time": time_base.description,
        "signals": [
            {"name": name, "unit": unit, "from": signals.mapping[name], **extremes(signals.columns[name])}
            for name, unit in signals.units.items()
        ],
        "notes": signals.notes,
        **_outer_rows({"time_s": time_base.deadline_ns * 1e-9} | shown),
        "about": dict(binding.table.about),
        "in_other_files": [*binding.table.in_other_files],
    }


def list_columns(path: Path, table: Table, selection: ColumnSelection) -> Mapping[str, object]:
    """Return the content of a file, with unit and extremes of each column.

    Keys: file, rows, time, time_column, rate_hz, notes, columns, first_rows, last_rows, about, in_other_files;
    `columns` are {name, unit, grows_evenly, least, largest}, `time_column` is the name of the column of times found,
    None without one; `time` is a text on the source of the times; each of the rows has the values by column. The
    columns of `selection` are not used. If nothing gives usable times, `time` and `rate_hz` are None, and `notes` says
    why. Raises AmbiguousData where two readings remain.
    """
    binding = bind(table, path, selection)
    base, table = binding.time_base, binding.table
    columns = [
        {"name": name, "unit": binding.units[name], "grows_evenly": grows_evenly(values), **extremes(values)}
        for name, values in table.columns.items()
    ]
    return {
        "file": str(path),
        "rows": row_count(table),
        "time": base and base.description,
        "rate_hz": base and base.rate_hz,
        "time_column": binding.clock,
        "notes": [*binding.notes, *(base.notes if base else [str(binding.fault).removeprefix(f"{path}: ")])],
        "columns": columns,
        **_outer_rows(table.columns),
        "about": dict(table.about),
        "in_other_files": [*table.in_other_files],
    }


def _outer_rows(columns: Mapping[str, Real]) -> dict[str, list[dict[str, float | None]]]:
    """Return {first_rows, last_rows}: OUTER_ROWS rows each, with the value of each column, None for no finite one."""
    count = min(map(len, columns.values()), default=0)
    rows = [
        {name: float(values[k]) if np.isfinite(values[k]) else None for name, values in columns.items()}
        for k in range(count)
        if k < OUTER_ROWS or k >= count - OUTER_ROWS
    ]
    return {"first_rows": rows[:OUTER_ROWS], "last_rows": rows[OUTER_ROWS:]}


def extremes(values: Real) -> dict[str, float | None]:
    """Return {least, largest} of the finite numbers; both None without one."""
    numbers = values[np.isfinite(values)]
    return (
        {"least": float(numbers.min()), "largest": float(numbers.max())}
        if numbers.size
        else dict.fromkeys(("least", "largest"))
    )


def _select_signals(binding: Binding, selection: ColumnSelection) -> ImportedSignals:
    """Return the selected columns as signals, tick and deadline first.

    Raises UnreadableData if a column is missing, ambiguous or of another unit, a name is reserved or mapped twice, no
    column besides the time is left, or the values of a signal of whole numbers, such as flags, are not whole.
    """
    signals = _select_columns(binding, selection)
    table, time_base = binding.table, binding.require_time()
    notes = [*binding.notes, *time_base.notes, *(c.assumption for c in signals.values() if c.assumption)]
    ticks, tick_notes = _import_ticks(table, len(time_base.deadline_ns))
    columns = {RECORDING_TIME_COLUMNS[0]: ticks, RECORDING_TIME_COLUMNS[1]: time_base.deadline_ns}
    for name, column in signals.items():
        columns[name] = column.values(table)
        if name in INTEGER_COLUMNS and (fault := integer_problem(name, columns[name])):
            raise UnreadableData(
                f"{binding.path}: {fault}; give column {column.name!r} another name with --map NAME=COLUMN"
            )
    missing = {name: np.count_nonzero(~np.isfinite(values)) for name, values in columns.items()}
    if any(missing.values()):
        notes.append(
            "missing or infinite values: " + ", ".join(f"{count} in {name}" for name, count in missing.items() if count)
        )
    return ImportedSignals(
        columns,
        {name: _header_text(column.description) for name, column in signals.items()},
        {name: _header_text(column.unit) for name, column in signals.items()},
        [*map(_header_text, notes), *tick_notes],
    )


def _select_columns(binding: Binding, selection: ColumnSelection) -> dict[str, MappedColumn]:
    """Return the selected columns by signal name; if none or `all` is selected, also all others except the times.

    A column kept under its own name gets a number appended if a signal, the tick or the deadline has this name.
    Raises UnreadableData for a missing or ambiguous column, a unit that does not fit, a reserved name, two mappings of
    one signal, and where no column besides the time is left.
    """
    table, path = binding.table, binding.path
    signals: dict[str, MappedColumn] = {}
    for given_name, source in selection.signals.items():
        if (name := signal_name(given_name)) in RECORDING_TIME_COLUMNS:
            raise UnreadableData(
                f"{path}: {name} is computed from the times and cannot be mapped; select the column of times "
                "with --time COLUMN"
            )
        if name in signals:
            first = next(other for other in selection.signals if signal_name(other) == name)
            raise UnreadableData(
                f"{path}: {first} and {given_name} are two mappings of the signal {name}; remove one of them"
            )
        signals[name] = map_column(table, path, name, source)
    plain_columns = [find_column(table, path, column_name) for column_name in selection.keep]
    if selection.all or not selection:
        used = {column.name for column in signals.values()} | {*plain_columns, *binding.time_columns}
        plain_columns += [name for name in table.columns if name not in used]
    for column in plain_columns:
        name = column if is_from_recording(table) and NAME.fullmatch(column) else default_signal_name(column)
        free_name = next(
            candidate
            for candidate in (name, *(f"{name}_{k}" for k in range(2, len(signals) + 4)))
            if candidate not in signals and candidate not in RECORDING_TIME_COLUMNS
        )
        if is_from_recording(table) and not table.units:
            unit = signal_unit(column)
        else:
            unit = require_one_unit(table, path, column, free_name) or ""
        signals[free_name] = MappedColumn(
            column, Fraction(1), 0.0, unit, f"{name_without_unit(column)} [{unit}]" if unit else column, None
        )
    if not signals:
        raise UnreadableData(f"{path}: contains no column besides the time")
    return signals


def _import_ticks(table: Table, rows: int) -> tuple[Real, list[str]]:
    """Return the ticks (rows,) of the new recording, and notes on them.

    The ticks of a table from a recording stay if they are whole numbers that rise, mostly by 1. Otherwise the ticks
    count from 0; for a table from a recording, a note says so.
    """
    new_ticks = np.arange(float(rows))
    if not is_from_recording(table):
        return new_ticks, []
    ticks = table.columns[RECORDING_TIME_COLUMNS[0]]
    steps = np.diff(ticks)
    if (
        integer_problem(RECORDING_TIME_COLUMNS[0], ticks) is None
        and np.all(steps >= 1)
        and (rows < 2 or np.median(steps) == 1)
    ):
        return ticks, []
    return new_ticks, [
        f"the ticks in the file, {ticks[0]:g} to {ticks[-1]:g}, do not number the samples one by one; the recording "
        "gets new ticks from 0"
    ]


def _make_header(path: Path, signals: ImportedSignals, time_base: TimeBase, is_position_first: bool) -> dict[str, Any]:
    """Return the header of the recording, with name and SHA-256 of the imported file.

    `is_position_first`: in each row the position was sampled before the drive changed.

    Raises OSError if the file can no longer be read.
    """
    with os.fdopen(open_user_file(path), "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    first = int(signals.columns[RECORDING_TIME_COLUMNS[0]][0])
    return {
        "format": format.FORMAT,
        "name": _header_text(path.stem),
        "created_unix_ns": max(path.stat().st_mtime_ns, 0),
        "axes": axis_names([*signals.units]),
        "observed": [],
        "columns": [*signals.columns],
        "rate_hz": time_base.rate_hz,
        "paced": False,
        "ticks_expected": len(time_base.deadline_ns),
        "first_tick": first,
        "configuration": "",
        "law": None,
        "realtime": {},
        "versions": {"rtloop": __version__},
        "host": {},
        "imported": {
            "file": _header_text(path.name),
            "sha256": digest,
            "time": _header_text(time_base.description),
            "mapping": signals.mapping,
            "units": signals.units,
            "notes": signals.notes,
            "position_first": is_position_first,
        },
    }


def _write_recording(
    output: Path, header: dict[str, Any], signals: ImportedSignals, rate_hz: float, progress: ReportTicks
) -> None:
    """Write all rows and the final event to the new file `output`; `progress` receives the number of ticks written.

    Raises OutputError if the file cannot be written, or exists, finished or unfinished; an existing file stays. The
    incomplete new file is removed after any error.
    """
    columns = [*signals.columns.values()]
    ticks, deadlines = columns[0], columns[1]
    step = format.chunk_rows(header["columns"])
    writer = Writer(output, header, header["created_unix_ns"], message_index=True, suffix=UNFINISHED_SUFFIX)

    def final_message(ticks_logged: int) -> Message:
        """Return the event that ends a recording of `ticks_logged` ticks, with its totals."""
        executed, end_ns = int(ticks[-1]) + 1, round(deadlines[-1] + 1e9 / rate_hz)
        lost = executed - header["first_tick"] - ticks_logged
        totals = {"ticks_executed": executed, "ticks_logged": ticks_logged, "ticks_lost": lost, "events_lost": 0}
        event = recorder_event(FINISHED, executed, end_ns, totals | {"result": "imported", "complete": lost == 0})
        return Message(format.EVENTS, writer.start_unix_ns + end_ns, json.dumps(event).encode())

    try:
        for start in range(0, len(ticks), step):
            writer.write_ticks(np.column_stack([column[start : start + step] for column in columns]))
            progress(writer.ticks)
        writer.finish(final_message, require_all=True)
    except BaseException:
        writer.discard()
        raise


def _header_text(text: str) -> str:
    """Return text suitable for a header: spaces for control characters, cut to MAX_TEXT_CHARACTERS."""
    return re.sub(r"[\x00-\x1f\x7f-\x9f]", " ", text)[:MAX_TEXT_CHARACTERS]
