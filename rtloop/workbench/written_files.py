"""Files that commands and results write."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from rtloop.errors import output_errors


def write_output(path: Path, content: bytes) -> None:
    """Write a file, and make its folder; an existing file is emptied first, so a failed write leaves an incomplete one.

    Raises OutputError if the system refuses.
    """
    from rtloop.foundation.trusted import overwrite_file

    with output_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with os.fdopen(overwrite_file(path), "wb") as file:
            file.write(content)


def write_configuration(path: Path, text: str) -> None:
    """Write a configuration once `prepare` accepts it; an existing file is replaced.

    Raises ConfigError for a configuration that cannot run, and then writes no file; OutputError if the system refuses.
    """
    from rtloop.configuration.file import parse
    from rtloop.configuration.prepare import prepare

    prepare(parse(text, path.stem, path.resolve().parent, str(path)))
    write_output(path, text.encode())


def path_from(file: Path, target: Path) -> str:
    """Return the path of `target` relative to the folder of `file`."""
    return os.path.relpath(target.resolve(), file.resolve().parent)


def write_outputs(folder: Path, contents: Mapping[str, bytes]) -> list[Path]:
    """Write the files `contents` (bytes by file name) to `folder`, which is made, over existing ones. Returns their
    paths.

    Raises OutputError if the system refuses a file; the files before it are then already written.
    """
    for name, content in contents.items():
        write_output(folder / name, content)
    return [folder / name for name in contents]
