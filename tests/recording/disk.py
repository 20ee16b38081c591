"""The file system under a recording, as its writer sees it: full, failing or without a free inode on demand."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

PLENTY_BYTES = 1 << 40


class Disk:
    """Replacement of `os.pwrite`, `os.open`, `os.fsync` and `os.statvfs`.

    Every write fails with the errno `error`, if set; the next fsync calls `at_fsync` first, if set.
    """

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.error: int | None = None
        self.at_fsync: Callable[[], object] | None = None
        self.longest_write_bytes = PLENTY_BYTES
        self.inodes = True
        self.free_bytes = PLENTY_BYTES
        self._pwrite, self._open, self._fsync, self._statvfs = os.pwrite, os.open, os.fsync, os.statvfs
        for name in ("pwrite", "open", "fsync", "statvfs"):
            patch.setattr(os, name, getattr(self, name))

    def pwrite(self, fd: int, data: Any, offset: int) -> int:
        """Write, or raise OSError: `error` if set, ENOSPC for data longer than `longest_write_bytes`."""
        number = self.error or (errno.ENOSPC if len(data) > self.longest_write_bytes else None)
        if number:
            raise OSError(number, os.strerror(number))
        return self._pwrite(fd, data, offset)

    def open(self, path: Any, flags: int, *arguments: Any, **options: Any) -> int:
        """Open a file; raise ENOSPC if it is to be created and no inode is free."""
        if flags & os.O_CREAT and not self.inodes:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._open(path, flags, *arguments, **options)

    def fsync(self, fd: int) -> None:
        """Call `at_fsync` once, if set, and then the real fsync."""
        action, self.at_fsync = self.at_fsync, None
        if action is not None:
            action()
        self._fsync(fd)

    def statvfs(self, path: Any) -> Any:
        """Return a status with `free_bytes` free, or none after ENOSPC; raise OSError if the folder is missing."""
        self._statvfs(path)
        free = 0 if self.error == errno.ENOSPC else self.free_bytes
        return SimpleNamespace(f_bavail=free, f_frsize=1)


def find_gaps(ticks: np.ndarray[Any, Any], executed: int) -> list[dict[str, int]]:
    """Return the gaps before, between and behind the recorded ticks (n,) of a run of `executed` ticks."""
    edges = np.concatenate([[-1], ticks, [executed]]).astype(int)
    return [
        {"first_tick": int(edges[i]) + 1, "count": int(edges[i + 1] - edges[i]) - 1}
        for i in np.flatnonzero(np.diff(edges) != 1)
    ]
