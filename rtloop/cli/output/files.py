"""Files that commands write."""

from __future__ import annotations

import os
from pathlib import Path

from rtloop.errors import output_errors


def write_output(path: Path, content: bytes) -> None:
    """Write a file, and make its folder; an existing file is replaced. Raises OutputError."""
    from rtloop.foundation.trusted import overwrite_file

    with output_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with os.fdopen(overwrite_file(path), "wb") as file:
            file.write(content)


def write_configuration(path: Path, text: str) -> None:
    """Write a configuration once it is known that it can run. Raises ConfigError, OutputError."""
    from rtloop.configuration.file import parse
    from rtloop.configuration.prepare import prepare

    prepare(parse(text, path.stem, path.resolve().parent, str(path)))
    write_output(path, text.encode())


def path_from(file: Path, other: Path) -> str:
    """Return the path of `other` as it stands in `file`: relative to the file's folder."""
    return os.path.relpath(other.resolve(), file.resolve().parent)
