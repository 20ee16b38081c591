"""Line numbers of the keys in a TOML file, so that a fault can be found; the text is valid TOML, or nearly.

tomllib keeps no places. This follows tables and keys at the beginning of lines; a part of a value over several lines is
found by its key.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from rtloop.configuration.text_files import MAX_TEXT_BYTES, read_regular

HEADER = re.compile(r"\s*(\[\[?)\s*([^\]]+?)\s*\]\]?\s*(?:#.*)?$")
KEY = re.compile(r"""\s*((?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*'))*)\s*=""")
NAME = re.compile(r"""\s*name\s*=\s*["']([^"']+)["']""")
PATH = re.compile(r"[A-Za-z0-9_.-]+")


def numbered(faults: Sequence[str], source: str) -> list[str]:
    """Return `faults`, each with the line of the key that it begins with, if `source` is a file with that key."""
    try:
        lines = key_lines(read_regular(Path(source), MAX_TEXT_BYTES).decode())
    except (OSError, ValueError):
        return list(faults)
    return [_numbered(fault, lines) for fault in faults]


def key_lines(text: str) -> dict[str, int]:
    """Line of each key and table by its dotted path; an entry of a list of tables goes by its name or its number."""
    lines: dict[str, int] = {}
    table, counts = "", dict[str, int]()
    current: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if header := HEADER.match(line):
            plain_path = ".".join(_parts(header[2]))
            if header[1] == "[[":
                counts[plain_path] = counts.get(plain_path, -1) + 1
                current[plain_path] = f"{plain_path}.{counts[plain_path]}"
            table = _resolve_path(plain_path, current)
            lines.setdefault(table, number)
        elif key := KEY.match(line):
            lines.setdefault(".".join(filter(None, (table, *_parts(key[1])))), number)
            if (name := NAME.match(line)) and table in current.values():
                _rename(lines, current, table, name[1])
                table = next(path for path in current.values() if path.endswith(f".{name[1]}"))
    return lines


def _numbered(fault: str, lines: dict[str, int]) -> str:
    """Return a fault with the line of the longest known part of its path."""
    path = match[0].rstrip(".") if (match := PATH.match(fault)) else ""
    while path:
        if path in lines:
            return f"line {lines[path]}: {fault}"
        path = path.rpartition(".")[0]
    return fault


def _resolve_path(table: str, current: dict[str, str]) -> str:
    """Return a table's path with the present entries of the lists that contain it."""
    for plain in sorted(current, key=len, reverse=True):
        if table == plain or table.startswith(f"{plain}."):
            return current[plain] + table[len(plain) :]
    return table


def _rename(lines: dict[str, int], current: dict[str, str], table: str, name: str) -> None:
    """Rename keys of a list's entry from its number to `name`, and record the new path in `current`."""
    list_path = table.rpartition(".")[0]
    current[list_path] = f"{list_path}.{name}"
    for path in [path for path in lines if path == table or path.startswith(f"{table}.")]:
        lines[current[list_path] + path[len(table) :]] = lines.pop(path)


def _parts(dotted: str) -> list[str]:
    """Return the parts of a dotted key, without quotes."""
    return [part.strip().strip("\"'") for part in dotted.split(".")]
