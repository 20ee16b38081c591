"""The file system under a recording, as far as its writer asks it: full, failing or without a free inode on demand."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtloop.recording.capture.session import Options, Session
from tests.recording.real_loop import BURST_TICKS, RealLoop, scheduled

PLENTY_BYTES = 1 << 40
NOTHING: Mapping[str, Any] = MappingProxyType({})


class Disk:
    """Takes the place of `os.pwrite`, `os.open`, `os.fsync` and `os.statvfs`.

    `error` is an errno that every write ends with, `at_fsync` is called once, when next a file is brought to the disk.
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
        """Fail with `error`, and with ENOSPC beyond `longest_write_bytes`."""
        number = self.error or (errno.ENOSPC if len(data) > self.longest_write_bytes else None)
        if number:
            raise OSError(number, os.strerror(number))
        return self._pwrite(fd, data, offset)

    def open(self, path: Any, flags: int, *arguments: Any, **options: Any) -> int:
        """Make no file where there is no inode."""
        if flags & os.O_CREAT and not self.inodes:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._open(path, flags, *arguments, **options)

    def fsync(self, fd: int) -> None:
        """Call `at_fsync` before it."""
        happens, self.at_fsync = self.at_fsync, None
        if happens is not None:
            happens()
        self._fsync(fd)

    def statvfs(self, path: Any) -> Any:
        """`free_bytes`, where the folder is there."""
        self._statvfs(path)
        free = 0 if self.error == errno.ENOSPC else self.free_bytes
        return SimpleNamespace(f_bavail=free, f_frsize=1)


class Recorded:
    """A run of a real law, recorded in the test's own process as a paced one; `said` goes into its header."""

    kind: type[Session] = Session

    def __init__(
        self, path: Path, text: str | None = None, said: Mapping[str, Any] = NOTHING, *, paced: bool = True,
        **options: Any,
    ) -> None:  # fmt: skip
        self.path, self.loop = path, RealLoop(scheduled() if text is None else text)
        self.header = {**self.loop.header, **said, "paced": paced}
        self.session = self.begin(**options)

    def begin(self, **options: Any) -> Session:
        """A recorder, or one that goes on where the last one died."""
        self.session = self.kind(self.loop.block, self.path, self.header, Options(**{"min_free_bytes": 0, **options}))
        return self.session

    def run_to(self, tick: int) -> None:
        """Execute ticks and drain them all; at least a chunk more than before is certainly written, or lost."""
        while self.loop.tick < tick:
            self.loop.run(min(BURST_TICKS, tick - self.loop.tick))
            while self.session.cursor < self.loop.tick:
                self.session.drain()
                self.session.write_due()

    def end(self) -> dict[str, Any]:
        """The totals."""
        return self.session.finish("finished")


def missing(ticks: np.ndarray[Any, Any], executed: int) -> list[dict[str, int]]:
    """The gaps between, before and behind recorded ticks (n,), of `executed` ones."""
    edges = np.concatenate([[-1], ticks, [executed]]).astype(int)
    return [
        {"first_tick": int(edges[i]) + 1, "count": int(edges[i + 1] - edges[i]) - 1}
        for i in np.flatnonzero(np.diff(edges) != 1)
    ]
