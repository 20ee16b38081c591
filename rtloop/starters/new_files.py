"""Writing of new files: all of them, or none where one exists already."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from pathlib import Path

from rtloop.errors import OutputError, output_errors
from rtloop.foundation.trusted import make_file


def write_new_files(folder: Path, texts: Mapping[str, str]) -> list[Path]:
    """Write texts by file name to `folder`, which is created. Returns the paths.

    Raises OutputError where a file exists already (none is written then), or if the system refuses (some may be
    written then).
    """
    paths = [folder / name for name in texts]
    for path in paths:
        if os.path.lexists(path):
            raise OutputError(
                f"{path}: the file exists already and is not overwritten; remove the file, or use another folder",
                errno.EEXIST,
            )
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for path, text in zip(paths, texts.values(), strict=True):
            with os.fdopen(make_file(path), "w", encoding="utf-8") as file:
                file.write(text)
    return paths
