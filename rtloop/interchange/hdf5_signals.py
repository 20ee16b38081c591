"""Signals appended to an HDF5 file block by block, a dataset each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import IO, TYPE_CHECKING

from rtloop.foundation.arrays import Real

if TYPE_CHECKING:
    import h5py

CHUNK_TICKS = 1 << 16
COMPRESSION = {"compression": "gzip", "compression_opts": 1, "shuffle": True}


def descriptor_path(file: IO[bytes]) -> str:
    """Return a Linux path, valid while `file` is open, by which the HDF5 library opens this file itself.

    The file's name may lead to another file by now.
    """
    return f"/proc/self/fd/{file.fileno()}"


def create_dataset(parent: h5py.Group, name: str) -> h5py.Dataset:
    """Create an empty, growing, compressed dataset of doubles in a group or file, and return it."""
    return parent.create_dataset(name, (0,), "<f8", maxshape=(None,), chunks=(CHUNK_TICKS,), **COMPRESSION)


def append_rows(datasets: Sequence[h5py.Dataset], rows: Real) -> None:
    """Append each column of `rows` (n, datasets) to the dataset at the same place in `datasets`."""
    for dataset, values in zip(datasets, rows.T, strict=True):
        length = dataset.shape[0]
        dataset.resize(length + len(values), axis=0)
        dataset[length:] = values
