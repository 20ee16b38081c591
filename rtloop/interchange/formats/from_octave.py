"""Octave's text format, `save FILE`: scalars, matrices, ranges and structures; other types are left out."""

from __future__ import annotations

import re
from contextlib import closing
from pathlib import Path

import numpy as np

from rtloop.interchange.formats.groups import FileColumns, select_table
from rtloop.interchange.formats.table import Table, UnreadableData
from rtloop.interchange.formats.text_source import TextSource

_HEAD = re.compile(rb"#\s*Created by Octave|#\s*name:\s*\S+\r?\n#\s*type:")


def is_octave(head: bytes) -> bool:
    """Whether a file begins as Octave's text format does."""
    return _HEAD.match(head) is not None


def read_octave(path: Path, group: str | None = None) -> Table:
    """Return the vectors and matrices of a group; a structure's fields by their path.

    Raises UnreadableData if the file is damaged or too large, or has no such group or no numbers.
    """
    columns, folders = FileColumns(path), list[tuple[str, int]]()
    name = kind = ""
    keys: dict[str, str] = {}
    numbers: list[list[float]] = []

    def finish() -> None:
        """Add the variable that was read."""
        full = "/".join([*(folder for folder, _ in folders), name])
        if kind.endswith("matrix") and "bool" not in kind and numbers:
            rows, count = int(keys.get("rows", len(numbers))), sum(map(len, numbers))
            width = int(keys.get("columns", 1))
            if count != rows * width or "ndims" in keys:
                raise UnreadableData(f"{path}: {name}: {count} numbers for {rows}×{width}; save the file again")
            columns.add_column(full, np.array([value for row in numbers for value in row]).reshape(rows, width))
        elif kind == "scalar" and numbers:
            columns.single[full] = numbers[0][0]
        elif kind in ("range", "double_range") and numbers:
            base, limit, step = _range(keys, numbers)
            columns.require_room(full, (round(abs((limit - base) / step)) + 1,))
            columns.add_column(full, base + step * np.arange(round((limit - base) / step) + 1))
        elif name and kind and "struct" not in kind and kind not in ("matrix", "string", "sq_string"):
            columns.left_out.append(f"{full} ({kind})")

    with closing(TextSource(path)) as source:
        lines = [*source.lines(0).numbered()]
    for number, line in lines:
        text = line.strip()
        if match := re.fullmatch(r"#\s*([\w ]+):\s*(.*)", text):
            key, value = match[1].strip(), match[2].strip()
            if key == "name":
                finish()
                name, kind, keys, numbers = value, "", {}, []
                while folders and folders[-1][1] == 0:
                    folders.pop()
                if folders:
                    folders[-1] = folders[-1][0], folders[-1][1] - 1
            elif key == "type":
                kind = value
            else:
                keys[key] = value
                if key == "length" and "struct" in kind:
                    folders.append((name, int(value)))
        elif text and not text.startswith("#") and kind and "string" not in kind:
            try:
                numbers.append([_number(field) for field in text.split()])
            except ValueError:
                if kind in ("matrix", "scalar"):
                    raise UnreadableData(f"{path}: {name}: line {number}: {text[:60]!r} is no number") from None
    finish()
    return select_table(path, columns.grouped_tables(), group)


def _number(text: str) -> float:
    return float("nan" if text == "NA" else text)


def _range(keys: dict[str, str], numbers: list[list[float]]) -> tuple[float, float, float]:
    """Return first, last and step of a range: "base, limit, increment" on one line, or in lines of keys."""
    if len(numbers[0]) >= 3:
        return numbers[0][0], numbers[0][1], numbers[0][2]
    return float(keys["base"]), float(keys["limit"]), float(keys["increment"])
