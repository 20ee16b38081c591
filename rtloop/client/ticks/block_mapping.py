"""Read-only mapping of a running loop's shared block."""

from __future__ import annotations

import json
import mmap
import os
from pathlib import Path

import numpy as np

from rtloop.engine.memory import DIRECTORY_BYTES, Word
from rtloop.engine.messages import MESSAGE
from rtloop.engine.ring import Ring
from rtloop.foundation.trusted import close_descriptor
from rtloop.supervision.paths import open_block


class BlockMapping:
    """Read-only mapping of the block in `fd`, which may be closed afterwards; `identity` is its device and inode."""

    def __init__(self, fd: int) -> None:
        """Map the block of the descriptor `fd`, which stays open, and read names, types and places of its arrays."""
        self._map = mmap.mmap(fd, 0, prot=mmap.PROT_READ)
        self._directory = json.loads(self._map[:DIRECTORY_BYTES].rstrip(b"\0"))
        self.identity = _identity(os.fstat(fd))

    def tick_ring(self) -> Ring:
        """Return the ring of ticks as read-only views of the block; `slots` (capacity, signals) holds the records."""
        return Ring(*(self._array(f"ticks_{part}") for part in Ring._fields))

    def event_ring(self) -> Ring:
        """Return the ring of events as read-only views of the block; `slots` (capacity,) of MESSAGE."""
        head, marks = (self._array(f"events_{part}") for part in ("head", "marks"))
        return Ring(head, marks, self._array("events_slots", MESSAGE))

    def load(self, word: Word) -> int:
        """Return a control word of the block."""
        return int(self["words"][word])

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a read-only view of the block's array `name`. Raises KeyError for an unknown name."""
        return self._array(name)

    def _array(self, name: str, dtype: np.dtype | None = None) -> np.ndarray:
        """Return a read-only view of the block's array `name`; `dtype` replaces the type that the block states.

        Raises KeyError for a name that the block does not have.
        """
        offset, type_name, shape = self._directory[name]
        array_dtype = np.dtype(type_name) if dtype is None else dtype
        return np.frombuffer(self._map, array_dtype, int(np.prod(shape)), offset).reshape(shape)


def open_mapping(path: Path) -> BlockMapping | None:
    """Map the shared block in the file `path` and return the mapping; None if the file is missing or still empty.

    Raises HostRefusal for a file that another user may have written, UnavailableError if it cannot be opened.
    """
    fd = open_block(path, os.O_RDONLY)
    if fd is None:
        return None
    try:
        return BlockMapping(fd) if os.pread(fd, 1, 0) == b"{" else None
    finally:
        close_descriptor(fd)


def is_current(mapping: BlockMapping, path: Path) -> bool:
    """Return whether the block in the file `path` is the mapped one; True also while no such file exists.

    No other file gets the inode of a mapped file.
    """
    try:
        return mapping.identity == _identity(os.stat(path))
    except OSError:
        return True  # The file was removed and has no successor yet.


def _identity(status: os.stat_result) -> tuple[int, int]:
    """Return (device number, inode number) of a file's status, which together identify the file."""
    return status.st_dev, status.st_ino
