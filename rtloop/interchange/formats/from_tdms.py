"""TDMS of LabVIEW and NI's cards, read by npTDMS: channels in their units, with the times of their waveforms."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.errors import MissingExtra
from rtloop.foundation.trusted import open_user_file
from rtloop.interchange.formats.groups import FileColumns, select_table
from rtloop.interchange.formats.table import Table, UnreadableData

UNIT_PROPERTIES = ("unit_string", "NI_UnitDescription", "Unit", "unit")


def read_tdms(path: Path, group: str | None = None) -> Table:
    """Return the channels of a group that share increment, start and length; by npTDMS they are scaled.

    The time of a waveform is wf_start_offset and wf_increment, in a column `time`. Channels of text and empty ones are
    left out. Raises UnreadableData if the file is damaged or too large, or has no such group or no numbers;
    MissingExtra without npTDMS.
    """
    try:
        from nptdms import TdmsFile
    except ImportError:
        raise MissingExtra("TDMS needs npTDMS: pip install 'rtloop[tdms]'") from None
    columns = FileColumns(path)
    try:
        with (
            os.fdopen(open_user_file(path), "rb") as stream,
            TdmsFile(stream, read_metadata_only=True, keep_open=True) as file,
        ):
            folders: dict[tuple[object, ...], str] = {}
            for member in file.groups():
                for channel in member.channels():
                    _add_channel(columns, member.name, channel, folders)
    except UnreadableData:
        raise
    except Exception as fault:  # the library documents no errors for a damaged file
        reason = f"{type(fault).__name__}: {str(fault)[:200]}"
        raise UnreadableData(f"{path}: not a TDMS file, or damaged ({reason})") from None
    return select_table(path, columns.grouped_tables(), group)


def _add_channel(columns: FileColumns, group: str, channel: Any, folders: dict[tuple[object, ...], str]) -> None:
    """Add a channel below its group; channels of another rate get a folder of their own, with its times."""
    name = f"{group}/{channel.name}"
    if len(channel) == 0:
        columns.left_out.append(f"{name} (empty)")
        return
    columns.require_room(name, (len(channel),))
    properties = channel.properties
    unit = next((str(properties[key]) for key in UNIT_PROPERTIES if properties.get(key)), None)
    values = np.asarray(channel[:])
    increment = properties.get("wf_increment")
    if values.dtype.kind == "M":
        ns = values.astype("datetime64[ns]").astype(np.int64)
        columns.add_column(name, (ns - ns[0]) * 1e-9, "s")
        return
    if not increment:
        columns.add_column(name, values, unit)
        return
    start, offset = properties.get("wf_start_time"), float(properties.get("wf_start_offset") or 0)
    key = (group, increment, offset, str(start), len(values))
    if key not in folders:
        others = sum(known[0] == group for known in folders)
        folders[key] = f"{group} ({1 / increment:g} Hz{', ' + str(others + 1) if others else ''})"
        columns.add_column(f"{folders[key]}/time", offset + increment * np.arange(len(values)), "s")
        columns.notes.append(
            f"{folders[key]}/{channel.name}: the times are wf_increment {increment:g} s, as the file states"
        )
    columns.add_column(f"{folders[key]}/{channel.name}", values, unit)
