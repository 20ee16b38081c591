"""Helpers of a law: Python files beside the law's file that the law imports, itself or by another helper.

They are found in the texts, without running one, so that the law and its helpers pass as texts to every process and
into the recording. A helper is a single file; packages, relative imports and names that are computed are not followed.
"""

from __future__ import annotations

import ast
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from rtloop.foundation.trusted import open_file

MAX_TEXT_BYTES = 1 << 20


class Helper(NamedTuple):
    """A module that a law imports: its name, its text, and its file, for messages."""

    name: str
    text: str
    file: str


def read_helpers(text: str, file: str) -> tuple[Helper, ...]:
    """Return the helpers of a law with this text in `file`, sorted by name; () for a text that is no Python.

    Raises ValueError for a helper that cannot be read, that another user owns or may change, a link, and one whose name
    is that of a standard or installed module.
    """
    helpers: dict[str, Helper] = {}
    pending = [(text, Path(file))]
    while pending:
        importing_text, importing_file = pending.pop()
        for name, line in _imported_names(importing_text):
            path = Path(file).with_name(f"{name}.py")
            if name in helpers or not os.path.lexists(path):
                continue
            if _is_other_module(name, path):
                if path == Path(file):  # The law has the name of a module, and imports that module.
                    continue
                raise ValueError(
                    f"{importing_file}, line {line}: imports {name}, but {path} has the name of a module of Python or "
                    "of an installed package; rename this file"
                )
            helpers[name] = Helper(name, _read(path), str(path))
            pending.append((helpers[name].text, path))
    return tuple(sorted(helpers.values()))


def _imported_names(text: str) -> Iterator[tuple[str, int]]:
    """Yield the top-level name of each module that a text imports, with the line; nothing for a text that is no Python.

    The error of such a text comes when it is run.
    """
    try:
        nodes = [*ast.walk(ast.parse(text))]
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from ((alias.name.partition(".")[0], node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module.partition(".")[0], node.lineno


def _is_other_module(name: str, path: Path) -> bool:
    """Whether `name` is a module of Python's library or an installed one, and not the file at `path`."""
    if name in sys.stdlib_module_names:
        return True
    specs = (finder.find_spec(name, None) for finder in sys.meta_path)
    origins = [spec.origin for spec in specs if spec is not None and spec.origin is not None]
    return bool(origins) and Path(origins[0]).resolve() != path.resolve()


def _read(path: Path) -> str:
    """Return the text of a helper. Raises ValueError if it cannot be read, is no text in UTF-8, or is not trusted."""
    try:
        with os.fdopen(open_file(path, os.O_RDONLY), "rb") as opened:
            data = opened.read(MAX_TEXT_BYTES + 1)
    except OSError as error:
        raise ValueError(f"{error.filename or path}: {error.strerror}") from None
    if len(data) > MAX_TEXT_BYTES:
        raise ValueError(f"{path}: more than {MAX_TEXT_BYTES} bytes; allowed: a helper of up to {MAX_TEXT_BYTES} bytes")
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not a text file in UTF-8 (fault at byte {error.start})") from None
