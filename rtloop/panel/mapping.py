"""A running loop's shared block, mapped so that nothing can be written through it."""

from __future__ import annotations

import json
import mmap
import os
from pathlib import Path

import numpy as np

from rtloop.engine.memory import DIRECTORY_BYTES
from rtloop.engine.messages import MESSAGE
from rtloop.engine.ring import Ring
from rtloop.foundation.trusted import close_descriptor
from rtloop.supervision.paths import open_block


class BlockMapping:
    """The block in `fd`, which may be closed afterwards; `identity` tells it from any other that exists meanwhile."""

    def __init__(self, fd: int) -> None:
        self._map = mmap.mmap(fd, 0, prot=mmap.PROT_READ)
        self._directory = json.loads(self._map[:DIRECTORY_BYTES].rstrip(b"\0"))
        self.identity = _identity(os.fstat(fd))

    def tick_ring(self) -> Ring:
        """The ring of ticks; its arrays cannot be written to."""
        return Ring(*(self._array(f"ticks_{part}") for part in Ring._fields))

    def event_ring(self) -> Ring:
        """The ring of events, likewise."""
        head, marks = (self._array(f"events_{part}") for part in ("head", "marks"))
        return Ring(head, marks, self._array("events_slots", MESSAGE))

    def _array(self, name: str, dtype: np.dtype | None = None) -> np.ndarray:
        offset, type_name, shape = self._directory[name]
        array_dtype = np.dtype(type_name) if dtype is None else dtype
        return np.frombuffer(self._map, array_dtype, int(np.prod(shape)), offset).reshape(shape)


def open_mapping(path: Path) -> BlockMapping | None:
    """The block at `path`; None where there is none, or nothing in it yet. Raises HostRefused, UnavailableError."""
    fd = open_block(path, os.O_RDONLY)
    if fd is None:
        return None
    try:
        return BlockMapping(fd) if os.pread(fd, 1, 0) == b"{" else None
    finally:
        close_descriptor(fd)


def is_current(mapping: BlockMapping, path: Path) -> bool:
    """Whether the block at `path` is still this one. A file that is mapped keeps its number to itself."""
    try:
        return mapping.identity == _identity(os.stat(path))
    except OSError:
        return True  # it was taken away: there is no other


def _identity(status: os.stat_result) -> tuple[int, int]:
    return status.st_dev, status.st_ino
