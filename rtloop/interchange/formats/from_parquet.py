"""Parquet: a column a signal; units from a field's metadata `unit`; a column of times counts from its first one."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rtloop.errors import MissingExtra
from rtloop.foundation.trusted import open_user_file
from rtloop.interchange.formats.groups import FileColumns, select_table
from rtloop.interchange.formats.table import Table, UnreadableData

if TYPE_CHECKING:
    import pyarrow


def read_parquet(path: Path, group: str | None = None) -> Table:
    """Return all columns of numbers and times: durations in s, dates in s from the first row.

    The table's `about` names the other columns, which are left out. Raises UnreadableData if the file cannot be opened,
    is no Parquet file, is damaged or too large, or has no column with two or more numbers; MissingExtra without
    pyarrow.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtra("Parquet needs pyarrow: pip install 'rtloop[data]'") from None
    columns = FileColumns(path)
    try:
        with os.fdopen(open_user_file(path), "rb") as stream, pyarrow.parquet.ParquetFile(stream) as file:
            schema = file.schema_arrow
            for field in schema:
                columns.require_room(field.name, (file.metadata.num_rows,))
                _add_field(columns, field, file.read(columns=[field.name]).column(0))
    except (pyarrow.ArrowException, OSError) as fault:
        raise UnreadableData(f"{path}: not a Parquet file, or damaged ({str(fault).splitlines()[0]})") from None
    table = select_table(path, columns.grouped_tables(), group)
    time_column = next((field.name for field in schema if pyarrow.types.is_timestamp(field.type)), None)
    return replace(table, time=table.time or time_column)


def _add_field(columns: FileColumns, field: pyarrow.Field, column: pyarrow.ChunkedArray) -> None:
    """Add a column of numbers or times to `columns`; columns of other types are listed as left out.

    Durations are in s, dates in s since the first row.
    """
    import pyarrow.types as types

    unit = (field.metadata or {}).get(b"unit", b"").decode("utf-8", "replace")
    if types.is_timestamp(field.type):
        ns = column.cast("timestamp[ns]").cast("int64").to_numpy()
        columns.add_column(field.name, (ns - ns[:1]) * 1e-9, "s")
    elif types.is_duration(field.type):
        columns.add_column(field.name, column.cast("duration[ns]").cast("int64").to_numpy() * 1e-9, "s")
    elif types.is_floating(field.type) or types.is_integer(field.type) or types.is_boolean(field.type):
        columns.add_column(field.name, np.asarray(column.to_numpy(), np.float64), unit)
    else:
        columns.left_out.append(f"{field.name} ({field.type})")
