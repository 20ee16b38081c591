"""Reading another program's file, whose format is found by its first bytes, not by its name."""

from __future__ import annotations

import os
import re
from pathlib import Path

from rtloop.foundation.trusted import open_user_file
from rtloop.interchange.formats.from_csv import read_csv
from rtloop.interchange.formats.from_hdf5 import read_hdf5
from rtloop.interchange.formats.from_lvm import is_labview, read_lvm
from rtloop.interchange.formats.from_mat import HDF5_MAGIC, HDF5_OFFSET, read_mat
from rtloop.interchange.formats.from_mf4 import read_mf4
from rtloop.interchange.formats.from_netcdf import read_netcdf
from rtloop.interchange.formats.from_npz import read_npz
from rtloop.interchange.formats.from_octave import is_octave, read_octave
from rtloop.interchange.formats.from_parquet import read_parquet
from rtloop.interchange.formats.from_stabilizer import MAGIC_BYTES, read_stabilizer
from rtloop.interchange.formats.from_tdms import read_tdms
from rtloop.interchange.formats.table import NO_HINTS, Hints, Table, UnopenedData

MCAP_MAGIC = b"\x89MCAP0\r\n"
READERS = (
    (HDF5_MAGIC, read_hdf5), (b"PK\x03\x04", read_npz), (b"PAR1", read_parquet), (b"TDSm", read_tdms),
    (b"MDF     ", read_mf4), (b"UnFinMF ", read_mf4), (b"CDF\x01", read_netcdf), (b"CDF\x02", read_netcdf),
)  # fmt: skip
"""Readers of a file and of a group in it, by the file's first bytes."""


def read_in_process(path: Path, hints: Hints = NO_HINTS) -> Table:
    """Return the columns of a file, read in this process; `hints.group` picks one of several rasters or groups.

    None: the longest one with several columns, or else the longest one; an MCAP file must then have a single topic. A
    library may raise any error for a damaged file, or crash: `isolated_reader.read_table` guards against it. Raises
    UnopenedData if the file cannot be opened; AmbiguousData if `hints` must decide; UnreadableData if it is of no known
    format, damaged, too large or has no such group; MissingExtra if the format's package is missing.
    """
    try:
        with os.fdopen(open_user_file(path), "rb") as file:
            head = file.read(HDF5_OFFSET + len(HDF5_MAGIC))
    except OSError as error:
        raise UnopenedData(f"{path}: {error.strerror}") from None
    if head.startswith(MCAP_MAGIC):
        from rtloop.interchange.formats.from_mcap import read_mcap

        return read_mcap(path, hints.group)
    if head.startswith(b"MATLAB"):
        return read_mat(path, hints.group)
    for magic, reader in READERS:
        if head.startswith(magic):
            return reader(path, hints.group)
    if head.startswith(MAGIC_BYTES):
        return read_stabilizer(path)
    if is_octave(head):
        return read_octave(path, hints.group)
    if is_labview(head):
        return read_lvm(path, hints)
    if path.suffix.lower() == ".mat" and not _is_table(head):
        return read_mat(path, hints.group)
    return read_csv(path, hints)


def _is_table(head: bytes) -> bool:
    """Whether a file begins with a number in text, as MATLAB's `save -ascii` writes it."""
    return re.match(rb"\s*[-+]?\d+(\.\d+)?(e[-+]\d+)?\s", head) is not None
