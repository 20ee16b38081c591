"""MF4 (ASAM MDF), read by asammdf: channels converted to their units, a group for each master channel."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from rtloop.errors import MissingExtra
from rtloop.foundation.trusted import open_user_file
from rtloop.interchange.formats.groups import FileColumns, select_table, unique_name, with_left_out
from rtloop.interchange.formats.table import Table, UnreadableData


def read_mf4(path: Path, group: str | None = None) -> Table:
    """Return the channels of a group: those with one master channel, which is the time.

    asammdf converts codes to values. Invalid samples are NaN. Texts and empty groups are left out. Raises
    UnreadableData if the file is damaged or too large, or has no such group or no numbers; MissingExtra without
    asammdf.
    """
    try:
        from asammdf import MDF
    except ImportError:
        raise MissingExtra("MF4 needs asammdf: pip install 'rtloop[mf4]'") from None
    tables: dict[str, Table] = {}
    room = FileColumns(path)
    try:
        with os.fdopen(open_user_file(path), "rb") as stream, MDF(stream) as file:
            for index, member in enumerate(file.groups):
                name = str(getattr(member.channel_group, "acq_name", "") or f"group {index}")
                columns = _read_group(room, file, index, len(member.channels))
                if columns is not None:
                    tables[unique_name(name, tables)] = columns
    except UnreadableData:
        raise
    except Exception as fault:  # the library documents no errors for a damaged file
        reason = f"{type(fault).__name__}: {str(fault)[:200]}"
        raise UnreadableData(f"{path}: not an MF4 file, or damaged ({reason})") from None
    if room.left_out:
        tables = {name: with_left_out(table, room.left_out) for name, table in tables.items()}
    return select_table(path, tables, group)


def _read_group(room: FileColumns, file: object, index: int, channels: int) -> Table | None:
    """Return the table of a group, without texts; None for an empty group."""
    columns = FileColumns(room.path)
    master = file.masters_db.get(index)  # type: ignore[attr-defined]
    times = np.asarray(file.get_master(index), np.float64)  # type: ignore[attr-defined]
    if times.size == 0:
        room.left_out.append(f"group {index} (empty)")
        return None
    room.require_room(f"group {index}", (times.size, channels))
    time = None
    if master is not None:
        time = "time"
        columns.add_column(time, times, "s")
    for number in range(channels):
        if number == master:
            continue
        signal = file.get(group=index, index=number, ignore_invalidation_bits=True)  # type: ignore[attr-defined]
        values = np.asarray(signal.samples)
        invalid = None if signal.invalidation_bits is None else np.asarray(signal.invalidation_bits, bool)
        if values.dtype.kind in "fiu" and invalid is not None and invalid.any():
            values = np.where(invalid, np.nan, values.astype(np.float64))
            columns.notes.append(f"{signal.name}: {int(invalid.sum())} missing, as the file states")
        columns.add_column(signal.name, values, signal.unit)
    room.left_out += columns.left_out
    if not columns.columns or (time and len(columns.columns) == 1):
        return None
    return Table(
        columns.columns,
        columns.units,
        time,
        origins=columns.origins,
        unnamed=tuple(columns.made_up),
        notes=tuple(columns.notes),
    )
