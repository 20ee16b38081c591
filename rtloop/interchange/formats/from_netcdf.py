"""NetCDF up to version 3, read by scipy; version 4 is HDF5."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

from rtloop.foundation.trusted import open_user_file
from rtloop.interchange.formats.groups import FileColumns, select_table
from rtloop.interchange.formats.scaling import unpack
from rtloop.interchange.formats.table import Table, UnreadableData


def read_netcdf(path: Path, group: str | None = None) -> Table:
    """Return the variables of a group, unpacked by the CF conventions.

    Raises UnreadableData if the file is damaged or too large, or has no such group or no numbers.
    """
    from scipy.io import netcdf_file

    columns = FileColumns(path)
    try:
        with warnings.catch_warnings(), os.fdopen(open_user_file(path), "rb") as file:
            warnings.simplefilter("ignore")
            content = netcdf_file(file, mmap=False)
            for name, variable in content.variables.items():
                columns.require_room(name, variable.shape or (1,))
                values = variable[...] if variable.shape else variable.getValue()
                unpack(columns, name, values, variable._attributes)
            for key, value in content._attributes.items():
                columns.single[key] = value
    except UnreadableData:
        raise
    except Exception as fault:  # scipy lets through whatever a damaged header leads to
        raise UnreadableData(f"{path}: not a NetCDF file, or damaged ({str(fault)[:200]})") from None
    return select_table(path, columns.grouped_tables(), group)
