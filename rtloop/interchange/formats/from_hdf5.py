"""HDF5: datasets in any depth of groups, matrices and records by column; units from attributes."""

from __future__ import annotations

from pathlib import Path

from rtloop.interchange.formats.groups import FileColumns, select_table
from rtloop.interchange.formats.hdf5 import collect_datasets
from rtloop.interchange.formats.table import Table


def read_hdf5(path: Path, group: str | None = None) -> Table:
    """Return the columns of `group`; for None, of the longest group with several columns, or else of the longest one.

    Raises UnreadableData if the file is no HDF5 file, damaged, too large or too deeply nested, or has no such group or
    no numbers; MissingExtra without h5py.
    """
    columns = FileColumns(path)
    collect_datasets(columns)
    return select_table(path, columns.grouped_tables(), group, columns.in_other_files)
