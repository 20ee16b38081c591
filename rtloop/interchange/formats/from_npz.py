"""numpy's npz: an array a signal, or matrices and records by column; nothing that is pickled."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np

from rtloop.hil.trusted import open_named
from rtloop.interchange.formats.groups import Found, one_of
from rtloop.interchange.formats.table import Table, UnreadableData

WORKBOOK = "xl/workbook.xml"


def read_npz(path: Path, group: str | None = None) -> Table:
    """The arrays of one length: `group`, else the only or the longest ones. Raises UnreadableData."""
    columns = Found(path)
    try:
        with os.fdopen(open_named(path), "rb") as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
        if any(member.filename == WORKBOOK for member in members):
            raise UnreadableData(f"{path}: an Excel workbook; save its sheet as CSV")
        for member in members:
            columns.room(member.filename, (-(-member.file_size // 8),))
        with os.fdopen(open_named(path), "rb") as file, np.load(file, allow_pickle=False) as arrays:
            for name in arrays:
                _add(columns, name, arrays)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, NotImplementedError, MemoryError) as fault:
        raise UnreadableData(f"{path}: not an npz file, or damaged ({fault})") from None
    return one_of(path, columns.tables(), group)


def _add(found: Found, name: str, arrays: np.lib.npyio.NpzFile) -> None:
    try:
        array = arrays[name]
    except ValueError:
        found.left_out.append(f"{name} (pickled objects)")
        return
    for field in array.dtype.names or ():
        found.add(f"{name}/{field}", array[field])
    if not array.dtype.names:
        found.add(name, array)
