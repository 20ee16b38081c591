"""numpy's npz: an array a signal, or matrices and records by column; pickled objects are left out."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np

from rtloop.foundation.trusted import open_user_file
from rtloop.interchange.formats.groups import FileColumns, select_table
from rtloop.interchange.formats.table import Table, UnreadableData

WORKBOOK = "xl/workbook.xml"


def read_npz(path: Path, group: str | None = None) -> Table:
    """Return the arrays of a group, which have one length, by its name `group`.

    For None, it is the longest group with several columns, or else the longest one. Raises UnreadableData if the file
    is no npz file, damaged, an Excel workbook or too large, or has no such group or no numbers.
    """
    columns = FileColumns(path)
    try:
        with os.fdopen(open_user_file(path), "rb") as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
        if any(member.filename == WORKBOOK for member in members):
            raise UnreadableData(f"{path}: an Excel workbook; save its sheet as CSV")
        for member in members:
            columns.require_room(member.filename, (-(-member.file_size // 8),))
        with os.fdopen(open_user_file(path), "rb") as file, np.load(file, allow_pickle=False) as arrays:
            for name in arrays:
                _add_array(columns, name, arrays)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, NotImplementedError, MemoryError) as fault:
        raise UnreadableData(f"{path}: not an npz file, or damaged ({fault})") from None
    return select_table(path, columns.grouped_tables(), group)


def _add_array(columns: FileColumns, name: str, arrays: np.lib.npyio.NpzFile) -> None:
    """Add the array `name`, or the fields of an array of records, to `columns`; list pickled objects as left out."""
    try:
        array = arrays[name]
    except ValueError:
        columns.left_out.append(f"{name} (pickled objects)")
        return
    for field in array.dtype.names or ():
        columns.add_column(f"{name}/{field}", array[field])
    if not array.dtype.names:
        columns.add_column(name, array)
