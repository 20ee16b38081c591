"""Removal of comments in a TOML text that describe sections which a design writes anew."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Mapping
from typing import Any

_HEADER = re.compile(r"^\s*\[\[?\s*([A-Za-z0-9_-]+(?:\s*\.\s*[A-Za-z0-9_-]+)*)\s*\]\]?\s*(?:#.*)?$")
_SCHEMA = re.compile(r"\A#:schema .*\n")
_COMMENT = re.compile(r"^\s*#")


def split_schema_line(text: str) -> tuple[str, str]:
    """Return the first line of a text with its line end if it begins with "#:schema ", otherwise "", and the rest."""
    match = _SCHEMA.match(text)
    return (match.group(), text[match.end() :]) if match else ("", text)


def remove_first_comments(text: str) -> str:
    """Return a configuration without its first paragraph if that is comments alone, which describe its former purpose.

    A first line `#:schema` stays; so does a paragraph that no other follows.
    """
    schema_line, text = split_schema_line(text)
    paragraph, gap, remainder = text.partition("\n\n")
    is_comment = all(line.startswith("#") for line in paragraph.splitlines())
    return schema_line + (remainder if gap and is_comment else text)


def remove_stale_comments(text: str, values: Mapping[str, object], rewritten: Collection[str]) -> str:
    """Return `text` without the comments of sections that `values` lacks, or that differ from `values` and lie in a
    table named in `rewritten`.

    Comments of a section are those directly above its heading, without an empty line between, and those above its keys.
    Comments behind a value stay. If the removal would change values, the text is returned unchanged. Raises
    TOMLDecodeError for a text that is not TOML.
    """
    old_values = tomllib.loads(text)
    cleaned_lines: list[str] = []
    pending: list[str] = []
    counts: dict[str, int] = {}
    is_stale = False
    for line in text.splitlines(keepends=True):
        names = _heading(line, old_values, counts)
        if names is None and (_COMMENT.match(line) or not line.strip()):
            pending.append(line)
            continue
        if names is not None:
            is_stale = _is_rewritten(names, old_values, values, rewritten)
            while is_stale and pending and _COMMENT.match(pending[-1]):
                pending.pop()
        elif is_stale:
            pending = []
        cleaned_lines += [*pending, line]
        pending = []
    cleaned = "".join([*cleaned_lines, *pending])
    return cleaned if _has_values(cleaned, old_values) else text


def _heading(line: str, values: Mapping[str, object], counts: dict[str, int]) -> list[str | int] | None:
    """Return the path of the section that a line begins, with indices of tables in lists, such as ["axis", 0, "model"];
    None for another line.

    `counts` has the number of headings [[…]] above this line by name, and is updated.
    """
    match = _HEADER.match(line)
    if match is None:
        return None
    names = [name.strip() for name in match.group(1).split(".")]
    if line.lstrip().startswith("[["):
        counts[".".join(names)] = counts.get(".".join(names), 0) + 1
    path: list[str | int] = []
    for end, name in enumerate(names, 1):
        path.append(name)
        if ".".join(names[:end]) in counts:
            path.append(counts[".".join(names[:end])] - 1)
    return path if isinstance(_find_value(values, path), Mapping) else None


def _is_rewritten(
    path: list[str | int], old: Mapping[str, object], new: Mapping[str, object], rewritten: Collection[str]
) -> bool:
    """Whether the section at a path is missing in `new`, or differs and lies in a table named in `rewritten`."""
    old_table, new_table = _find_value(old, path), _find_value(new, path)
    return new_table is None or (old_table != new_table and not set(rewritten).isdisjoint(map(str, path)))


def _find_value(values: Any, path: list[str | int]) -> object:
    """Return the value at a path of keys and indices, or None where there is none."""
    for part in path:
        try:
            values = values[part]
        except (KeyError, IndexError, TypeError):
            return None
    return values


def _has_values(text: str, values: Mapping[str, object]) -> bool:
    """Whether a text is TOML of exactly these values."""
    try:
        return tomllib.loads(text) == values
    except tomllib.TOMLDecodeError:
        return False
