"""Reading another program's file, whose format is found by its first bytes, not by its name."""

from __future__ import annotations

import os
from pathlib import Path

from rtloop.foundation.trusted import open_user_file
from rtloop.interchange.formats.from_csv import read_csv
from rtloop.interchange.formats.from_hdf5 import read_hdf5
from rtloop.interchange.formats.from_mat import HDF5_MAGIC, HDF5_OFFSET, read_mat
from rtloop.interchange.formats.from_npz import read_npz
from rtloop.interchange.formats.from_parquet import read_parquet
from rtloop.interchange.formats.from_stabilizer import MAGIC_BYTES, read_stabilizer
from rtloop.interchange.formats.table import Table, UnopenedData

MCAP_MAGIC = b"\x89MCAP0\r\n"


def read_in_process(path: Path, group: str | None = None) -> Table:
    """Return the columns of a file, read in this process; `group` picks one of several rasters, groups or topics.

    None: the longest one with several columns, or else the longest one; an MCAP file must then have a single topic. A
    library may raise any error for a damaged file, or crash: `isolated_reader.read_table` guards against it. Raises
    UnopenedData if the file cannot be opened; UnreadableData if it is of no known format, damaged, too large or has no
    such group; MissingExtra if the format's package is missing.
    """
    try:
        with os.fdopen(open_user_file(path), "rb") as file:
            head = file.read(HDF5_OFFSET + len(HDF5_MAGIC))
    except OSError as error:
        raise UnopenedData(f"{path}: {error.strerror}") from None
    if head.startswith(MCAP_MAGIC):
        from rtloop.interchange.formats.from_mcap import read_mcap

        return read_mcap(path, group)
    if head.startswith(b"MATLAB") or path.suffix.lower() == ".mat":
        return read_mat(path, group)
    if head.startswith(HDF5_MAGIC):
        return read_hdf5(path, group)
    if head.startswith(b"PK\x03\x04"):
        return read_npz(path, group)
    if head.startswith(b"PAR1"):
        return read_parquet(path)
    if head.startswith(MAGIC_BYTES):
        return read_stabilizer(path)
    return read_csv(path)
