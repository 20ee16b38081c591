"""Another program's measurement as a recording: signals and their times, and nothing of a law.

Times are kept as they are, jitter and all; what is odd about them is told, and stays in the recording's header.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtloop import __version__
from rtloop.hil.modal import Real
from rtloop.hil.trusted import open_named
from rtloop.interchange.aside import read_table
from rtloop.interchange.formats.groups import rows_of
from rtloop.interchange.formats.table import Table, UnreadableData
from rtloop.interchange.mapping import Column, axes_of, bare, column_of, find_column, own_name, signal_name, unit_in
from rtloop.interchange.sampling import (
    OWN,
    Sampling,
    came_from_a_recording,
    grows_evenly,
    sampling,
    time_column,
)
from rtloop.interchange.wanted import NAME, Wanted
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.events import FINISHED, recorder_event
from rtloop.recording.file.topics.ticks import WHOLE, whole_fault
from rtloop.recording.file.writer import Writer
from rtloop.recording.load import unit_of

UNFINISHED = ".importing"
LONGEST_WORDS = 200

Progress = Callable[[int], None]


class Signals(NamedTuple):
    """What a recording is made of: columns by name, the first two being OWN; each (rows,) float64."""

    columns: dict[str, Real]
    mapping: dict[str, str]
    units: dict[str, str]
    notes: list[str]


def import_data(
    path: Path,
    wanted: Wanted,
    output: Path | None = None,
    *,
    table: Table | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the wanted columns of a file as the recording `output`, NAME.mcap beside it by default.

    All columns where nothing is wanted. `table` is what is in the file, if that was read already; `progress` is told
    the ticks so far. Returns {file, output, ticks, rate_hz, duration_s, time, signals, notes, about, in_other_files}.
    Raises UnreadableData, MissingExtra, OutputError; nothing is left of an output that could not be written.
    """
    table = read_table(path, wanted.group) if table is None else table
    time_base = sampling(table, path, wanted.time, wanted.rate_hz)
    signals = _signals(table, path, wanted, time_base)
    output = output or path.with_name(f"{path.stem}{'.imported' if path.suffix == '.mcap' else ''}.mcap")
    _write(output, _header(path, signals, time_base), signals, time_base.rate_hz, progress or (lambda _: None))
    return {
        "file": str(path),
        "output": str(output),
        "ticks": len(time_base.deadline_ns),
        "rate_hz": time_base.rate_hz,
        "duration_s": float(np.ptp(time_base.deadline_ns)) * 1e-9 + 1 / time_base.rate_hz,
        "time": time_base.said,
        "signals": [
            {"name": name, "unit": unit, "from": signals.mapping[name], **extremes(signals.columns[name])}
            for name, unit in signals.units.items()
        ],
        "notes": signals.notes,
        "about": dict(table.about),
        "in_other_files": [*table.in_other_files],
    }


def listing(path: Path, table: Table, wanted: Wanted) -> dict[str, Any]:
    """What is in a file: {file, rows, time, time_column, rate_hz, notes, columns, about, in_other_files}."""
    columns = [
        {"name": name, "unit": unit_in(table, name), "grows_evenly": grows_evenly(values), **extremes(values)}
        for name, values in table.columns.items()
    ]
    summary: dict[str, Any] = {"time": None, "rate_hz": None, "time_column": time_column(table)}
    try:
        time_base = sampling(table, path, wanted.time, wanted.rate_hz)
        summary |= {"time": time_base.said, "rate_hz": time_base.rate_hz, "notes": time_base.notes}
    except UnreadableData as fault:
        summary["notes"] = [str(fault).removeprefix(f"{path}: ")]
    return {"file": str(path), "rows": rows_of(table), **summary, "columns": columns, "about": dict(table.about)} | {
        "in_other_files": [*table.in_other_files]
    }


def extremes(values: Real) -> dict[str, float | None]:
    """The least and the largest number; None where there is none."""
    numbers = values[np.isfinite(values)]
    return (
        {"least": float(numbers.min()), "largest": float(numbers.max())}
        if numbers.size
        else dict.fromkeys(("least", "largest"))
    )


def _signals(table: Table, path: Path, wanted: Wanted, found: Sampling) -> Signals:
    """The wanted columns as signals. Raises UnreadableData."""
    signals = _columns(table, path, wanted)
    notes = [*found.notes, *(column.assumed for column in signals.values() if column.assumed)]
    ticks, tick_notes = _ticks(table, len(found.deadline_ns))
    columns = {OWN[0]: ticks, OWN[1]: found.deadline_ns}
    for name, column in signals.items():
        columns[name] = column.values(table)
        if name in WHOLE and (fault := whole_fault(name, columns[name])):
            raise UnreadableData(f"{path}: {fault}; --map says another name for it")
    missing = {name: np.count_nonzero(~np.isfinite(values)) for name, values in columns.items()}
    if any(missing.values()):
        notes.append("no numbers: " + ", ".join(f"{count} in {name}" for name, count in missing.items() if count))
    return Signals(
        columns,
        {name: _words(column.said) for name, column in signals.items()},
        {name: _words(column.unit) for name, column in signals.items()},
        [*map(_words, notes), *tick_notes],
    )


def _columns(table: Table, path: Path, wanted: Wanted) -> dict[str, Column]:
    """By signal's name. Raises UnreadableData for a name that is taken, or where nothing is left to be a signal."""
    signals: dict[str, Column] = {}
    for name, source in wanted.signals.items():
        if (name := signal_name(name)) in OWN:
            raise UnreadableData(f"{path}: {name} is made of the time; --time says which column that is")
        signals[name] = column_of(table, path, name, source)
    plain_columns = [find_column(table, path, column_name) for column_name in wanted.keep]
    if wanted.everything or not wanted:
        used = {column.name for column in signals.values()} | {*plain_columns, *_times(table, path, wanted)}
        plain_columns += [name for name in table.columns if name not in used]
    for column in plain_columns:
        name = column if came_from_a_recording(table) and NAME.fullmatch(column) else own_name(column)
        free_name = next(
            candidate
            for candidate in (name, *(f"{name}_{k}" for k in range(2, len(signals) + 3)))
            if candidate not in signals
        )
        unit = unit_of(column) if came_from_a_recording(table) and not table.units else unit_in(table, column) or ""
        signals[free_name] = Column(
            column, Fraction(1), 0.0, unit, f"{bare(column)} [{unit}]" if unit else column, None
        )
    if not signals:
        raise UnreadableData(f"{path}: holds no column beside its time")
    return signals


def _times(table: Table, path: Path, wanted: Wanted) -> set[str | None]:
    """Columns that are times, and no signals."""
    if came_from_a_recording(table):
        return {*OWN, table.time}
    time_column_name = None if wanted.time is None else column_of(table, path, "", wanted.time).name
    return {time_column(table), time_column_name}


def _ticks(table: Table, rows: int) -> tuple[Real, list[str]]:
    """The ticks of what came from a recording, where they count samples one by one; else they are counted anew."""
    new_ticks = np.arange(float(rows))
    if not came_from_a_recording(table):
        return new_ticks, []
    ticks = table.columns[OWN[0]]
    steps = np.diff(ticks)
    if whole_fault(OWN[0], ticks) is None and np.all(steps >= 1) and (rows < 2 or np.median(steps) == 1):
        return ticks, []
    return new_ticks, [f"its ticks, {ticks[0]:g} to {ticks[-1]:g}, do not count its samples; they are counted anew"]


def _header(path: Path, signals: Signals, found: Sampling) -> dict[str, Any]:
    with os.fdopen(open_named(path), "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    first = int(signals.columns[OWN[0]][0])
    return {
        "format": format.FORMAT,
        "name": _words(path.stem),
        "created_unix_ns": max(path.stat().st_mtime_ns, 0),
        "axes": axes_of([*signals.units]),
        "observed": [],
        "columns": [*signals.columns],
        "rate_hz": found.rate_hz,
        "paced": False,
        "ticks_expected": len(found.deadline_ns),
        "first_tick": first,
        "configuration": "",
        "law": None,
        "realtime": {},
        "versions": {"rtloop": __version__},
        "host": {},
        "imported": {
            "file": _words(path.name),
            "sha256": digest,
            "time": _words(found.said),
            "mapping": signals.mapping,
            "units": signals.units,
            "notes": signals.notes,
        },
    }


def _write(output: Path, header: dict[str, Any], signals: Signals, rate_hz: float, progress: Progress) -> None:
    """All rows, and the end. Raises OutputError; nothing is left of the file then."""
    columns = [*signals.columns.values()]
    ticks, deadlines = columns[0], columns[1]
    step = format.chunk_rows(header["columns"])
    writer = Writer(output, header, header["created_unix_ns"], message_index=True, suffix=UNFINISHED)

    def final(logged: int) -> Message:
        executed, end_ns = int(ticks[-1]) + 1, round(deadlines[-1] + 1e9 / rate_hz)
        lost = executed - header["first_tick"] - logged
        totals = {"ticks_executed": executed, "ticks_logged": logged, "ticks_lost": lost, "events_lost": 0}
        event = recorder_event(FINISHED, executed, end_ns, totals | {"result": "imported", "complete": lost == 0})
        return Message(format.EVENTS, writer.start_unix_ns + end_ns, json.dumps(event).encode())

    try:
        for start in range(0, len(ticks), step):
            writer.write_ticks(np.column_stack([column[start : start + step] for column in columns]))
            progress(writer.ticks)
        writer.finish(final, whole=True)
    except BaseException:
        writer.discard()
        raise


def _words(text: str) -> str:
    """As a recording's header may have it: no control characters, and not too long."""
    return re.sub(r"[\x00-\x1f\x7f-\x9f]", " ", text)[:LONGEST_WORDS]
