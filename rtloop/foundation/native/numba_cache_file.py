"""numba's files in the cache, whole or not at all; its own writer leaves it to the disk whether they are."""

from __future__ import annotations

import errno
import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numba.core.caching import IndexDataCacheFile

from rtloop.foundation.native import cache_files as stored


class CheckedCacheFile(IndexDataCacheFile):
    """Index and data of one kernel. A damaged file counts as none, and is written anew."""

    def _load_index(self) -> Any:
        """What the kernel was compiled for, and the files with what came of it; empty where that is not known."""
        return super()._load_index() if stored.read(Path(self._index_path)) is not None else {}

    def _load_data(self, name: str) -> Any:
        """What came of the compilation. Raises OSError where that is not known, which numba takes for its absence."""
        if stored.read(Path(self._data_path(name))) is None:
            raise FileNotFoundError(errno.ENOENT, "damaged, or not there", name)
        return super()._load_data(name)

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[Any]:
        """What is written here is stored at once and whole; numba reads no further than what it has written."""
        buffer = io.BytesIO()
        yield buffer
        stored.write(Path(filepath), buffer.getvalue())
