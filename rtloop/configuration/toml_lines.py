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
SYNTAX = re.compile(
    r"(?P<message>not valid TOML: .*) \(at (?:line (?P<line>\d+), column (?P<column>\d+)|end of document)\)$"
)
TEXT_OR_COMMENT = re.compile(r"""("(?:[^"\\]|\\.)*"|'[^']*')|#.*$""")
WORDS = ("true", "false", "inf", "nan")
"""Values of TOML that are words."""
MAX_SHOWN = 100
"""Characters shown of a line."""
PATH = re.compile(r"[A-Za-z0-9_.-]+")


def numbered(faults: Sequence[str], source: str) -> list[str]:
    """Return `faults`, each as "line N: FAULT" with the line of the key that it begins with, if `source` is a file that
    has this key or a part of its path; any other fault unchanged.

    A fault of TOML syntax gets the text of its line, which this user may read, and the likely mistake.
    """
    try:
        text = read_regular(Path(source), MAX_TEXT_BYTES).decode()
    except (OSError, ValueError):
        return list(faults)
    lines = key_lines(text)
    return [_quote_line(match, text) if (match := SYNTAX.match(fault)) else _numbered(fault, lines) for fault in faults]


def _quote_line(fault: re.Match[str], text: str) -> str:
    """Return a fault of TOML syntax with line, column and text of the line where it, or its open bracket, begins.

    `fault` is a match of SYNTAX, `text` the whole file.
    """
    lines = text.splitlines()
    written = [number for number, line in enumerate(lines, start=1) if line.strip()]
    number, column = (
        int(fault["line"] or (written or [1])[-1]),
        f", column {fault['column']}" if fault["column"] else "",
    )
    if fault["message"].startswith(("not valid TOML: Unclosed", "not valid TOML: Unterminated")):
        column = ""
        openings = [k for k in range(number, 0, -1) if KEY.match(lines[k - 1]) and _guess_mistake(lines[k - 1])]
        number = (openings or [number])[0]
    line = "".join(letter if letter.isprintable() else " " for letter in lines[number - 1]).strip()
    hint = _guess_mistake(line)
    return f"line {number}{column}: {fault['message']}{f'; {hint}' if hint else ''}, in: {line[:MAX_SHOWN]}"


def _guess_mistake(line: str) -> str:
    """Return the likely mistake of TOML syntax in a line; "" for none."""
    statement = TEXT_OR_COMMENT.sub(lambda match: match[1] or "", line)
    if number := re.search(r"=\s*[-+]?(\d+),(\d+)\s*$", statement):
        return f"a decimal number has a point: {number[1]}.{number[2]}"
    if statement.count('"') % 2 or (statement.count("'") % 2 and '"' not in statement):
        return "a quotation mark is missing"
    for opening, closing in ("[]", "{}"):
        if statement.count(opening) != statement.count(closing):
            return f"a bracket is missing, {opening} or {closing}"
    word = re.search(r"=\s*([A-Za-z_][\w./-]*)\s*$", statement)
    if word and word[1] not in WORDS:
        is_boolean = word[1] in ("True", "False")
        return f"write {word[1].lower()}" if is_boolean else f'text has quotation marks: "{word[1]}"'
    return ""


def key_lines(text: str) -> dict[str, int]:
    """Return the line, from 1, of each key and table by its dotted path.

    An entry of a list of tables goes by its name, or by its number from 0.
    """
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
    """Return a fault with the line of the longest part of its path in `lines`, as `key_lines` returns them.

    A fault without such a part is returned unchanged.
    """
    path = match[0].rstrip(".") if (match := PATH.match(fault)) else ""
    while path:
        if path in lines:
            return f"line {lines[path]}: {fault}"
        path = path.rpartition(".")[0]
    return fault


def _resolve_path(table: str, current: dict[str, str]) -> str:
    """Return a table's path with the present entries of the lists of tables that contain it.

    `current` has the path of the present entry by the path of its list.
    """
    for plain in sorted(current, key=len, reverse=True):
        if table == plain or table.startswith(f"{plain}."):
            return current[plain] + table[len(plain) :]
    return table


def _rename(lines: dict[str, int], current: dict[str, str], table: str, name: str) -> None:
    """Rename the keys of a list's entry `table` in `lines` from its number to `name`; store its path in `current`."""
    list_path = table.rpartition(".")[0]
    current[list_path] = f"{list_path}.{name}"
    for path in [path for path in lines if path == table or path.startswith(f"{table}.")]:
        lines[current[list_path] + path[len(table) :]] = lines.pop(path)


def _parts(dotted: str) -> list[str]:
    """Return the parts of a dotted key, without quotes."""
    return [part.strip().strip("\"'") for part in dotted.split(".")]
