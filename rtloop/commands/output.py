"""Files that commands write over what is there."""

from __future__ import annotations

import os
from pathlib import Path

from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.errors import output_errors
from rtloop.foundation.trusted import overwrite_file


def write_over(path: Path, content: bytes) -> None:
    """Write a file, and its folder where there is none. Raises OutputError."""
    with output_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with os.fdopen(overwrite_file(path), "wb") as file:
            file.write(content)


def write_configuration(path: Path, text: str) -> None:
    """The same with a configuration, if it can run. Raises ConfigError, OutputError."""
    prepare(parse(text, path.stem, path.resolve().parent, str(path)))
    write_over(path, text.encode())
