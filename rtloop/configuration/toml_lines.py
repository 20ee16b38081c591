"""In which line of a TOML file a key stands, so that a fault can be found; the text is valid TOML, or nearly.

tomllib keeps no places. This follows tables and keys at the beginning of lines; what stands within a value of several
lines is found by its key.
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
    """`faults`, each with the line of the key that it begins with, where `source` is a file that has it."""
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
            table = _within(plain_path, current)
            lines.setdefault(table, number)
        elif key := KEY.match(line):
            lines.setdefault(".".join(filter(None, (table, *_parts(key[1])))), number)
            if (name := NAME.match(line)) and table in current.values():
                _rename(lines, current, table, name[1])
                table = next(path for path in current.values() if path.endswith(f".{name[1]}"))
    return lines


def _numbered(fault: str, lines: dict[str, int]) -> str:
    """With the line of the longest part of its path that there is."""
    path = match[0].rstrip(".") if (match := PATH.match(fault)) else ""
    while path:
        if path in lines:
            return f"line {lines[path]}: {fault}"
        path = path.rpartition(".")[0]
    return fault


def _within(table: str, current: dict[str, str]) -> str:
    """A table's path, with the present entries of the lists that it is in."""
    for plain in sorted(current, key=len, reverse=True):
        if table == plain or table.startswith(f"{plain}."):
            return current[plain] + table[len(plain) :]
    return table


def _rename(found: dict[str, int], current: dict[str, str], table: str, name: str) -> None:
    """What stands under an entry's number goes by its name from now on."""
    list_path = table.rpartition(".")[0]
    current[list_path] = f"{list_path}.{name}"
    for path in [path for path in found if path == table or path.startswith(f"{table}.")]:
        found[current[list_path] + path[len(table) :]] = found.pop(path)


def _parts(dotted: str) -> list[str]:
    """The parts of a dotted key, without quotes."""
    return [part.strip().strip("\"'") for part in dotted.split(".")]
