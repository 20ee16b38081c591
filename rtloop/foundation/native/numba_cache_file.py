"""numba's files in the cache, written atomically and checked by their digest, which numba does not do."""

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
    """Index and data of one kernel. A damaged file is treated as missing and written again."""

    def _load_index(self) -> dict[tuple[object, ...], str]:
        """Return a dict from each signature of the kernel to the file name of its code.

        It is empty if the index is missing or damaged.
        """
        return super()._load_index() if stored.read(Path(self._index_path)) is not None else {}

    def _load_data(self, name: str) -> object:
        """Return the code in file `name`. Raises FileNotFoundError if damaged or missing: numba compiles again."""
        if stored.read(Path(self._data_path(name))) is None:
            raise FileNotFoundError(errno.ENOENT, "damaged, or not there", name)
        return super()._load_data(name)

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[Any]:
        """Yield a buffer whose contents are stored atomically on exit, but not after an exception.

        numba ignores the digest that follows them.
        """
        buffer = io.BytesIO()
        yield buffer
        stored.write(Path(filepath), buffer.getvalue())
