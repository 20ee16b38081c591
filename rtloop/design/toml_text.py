"""TOML from plain values: numbers are written so that reading them gives the same bits."""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Mapping, MutableMapping, Sequence
from typing import Any, TypeGuard

import numpy as np
import numpy.typing as npt
import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, Array, Item, Key, Table

from rtloop.design.stale_comments import remove_stale_comments, split_schema_line
from rtloop.linear.transfer import Transfer

LIST_WIDTH = 90
"""Longest list in characters that is written in one line."""


def write_section(name: str, values: Mapping[str, object], comments: Sequence[str] = ()) -> str:
    """Return TOML of `[name]` with its keys, below `comments`, lines without #; nested tables become sections, lists of
    tables [[…]].

    For `name` "", `values` are the whole document; dots in `name` nest sections.
    """
    document = tomlkit.document()
    for comment in comments:
        document.add(tomlkit.comment(comment))
    nested: Mapping[str, object] = values
    for part in reversed(name.split(".") if name else []):
        nested = {part: nested}
    for key, value in _order_values(nested):
        document.add(key, toml_item(value))
    return document.as_string()


def edit_text(
    text: str, values: Mapping[str, object], comments: Sequence[str] = (), rewritten: Collection[str] = ()
) -> str:
    """Return `text` changed to hold `values` and no other keys, with its old comments, below new `comments`.

    A first line `#:schema` stays the first. A comment is removed with its section or value, with a value that changes,
    and with a table named in `rewritten` that differs. If `text` is no TOML or of a form that cannot be changed in
    place, the values are written without the old comments.
    """
    heading = "".join(f"# {comment}".rstrip() + "\n" for comment in comments)
    schema_line, text = split_schema_line(text)
    try:
        document = tomlkit.parse(remove_stale_comments(text, values, rewritten))
        _update_table(document, values)
        edited_text = "\n".join(filter(None, (schema_line, heading, document.as_string().lstrip("\n"))))
        if tomllib.loads(edited_text) == values:
            return edited_text
    except (TOMLKitError, tomllib.TOMLDecodeError):
        pass
    return "\n".join(filter(None, (schema_line, write_section("", values, comments))))


def _update_table(table: Any, values: Mapping[str, object]) -> None:
    """Change a parsed table in place so that it holds `values` and no other keys.

    Comments stay, but for one behind a value that changes. Comments at the end of the table stay at its end: they
    describe the table that follows.
    """
    for key in [key for key in table if key not in values]:
        table.remove(key)
    last_lines = _take_last_lines(table)
    for key, value in _order_values(values):
        present = table.get(key)
        if key in table and present == value:
            continue
        if isinstance(present, MutableMapping) and isinstance(value, Mapping):
            _update_table(present, value)
        elif isinstance(present, AoT) and _is_tables(value) and len(present) == len(value):
            for old_table, new_values in zip(present, value, strict=True):
                _update_table(old_table, new_values)
        else:
            table[key] = added = toml_item(value)
            added.trivia.comment_ws = added.trivia.comment = ""  # behind the old value
            if isinstance(added, Table):
                added.add(tomlkit.nl())
    _find_last_entries(table).extend(last_lines)


def _take_last_lines(table: object) -> list[tuple[Key | None, Item]]:
    """Remove comments and empty lines behind the last key of a table and its tables; return them."""
    body = _find_last_entries(table)
    first = next((i for i in range(len(body), 0, -1) if body[i - 1][0] is not None), 0)
    lines = body[first:]
    del body[first:]
    return lines


def _find_last_entries(table: object) -> list[tuple[Key | None, Item]]:
    """Return the list of entries, (key or None, item), of the last table within a table or document, or of that itself
    if it contains no table. The list is tomlkit's own: a change of the list changes the document.
    """
    while True:
        if isinstance(table, AoT):
            table = table.body[-1]
        body: list[tuple[Key | None, Item]] = (
            table.value.body if isinstance(table, Table) else getattr(table, "body", [])
        )
        last = next((item for key, item in reversed(body) if key is not None), None)
        if not isinstance(last, Table | AoT) or not last:
            return body
        table = last


def toml_item(value: object) -> Item:
    """Return a value as TOML item: a mapping as table, a list of mappings as tables [[…]], another list as array, in
    which mappings are inline tables.
    """
    if isinstance(value, Mapping):
        return _table(value, holds_tables_alone=bool(value) and all(map(_is_table, value.values())))
    if _is_tables(value):
        tables = tomlkit.aot()
        for table in value:
            tables.append(_table(table))
        return tables
    if isinstance(value, list | tuple | np.ndarray):
        return _array(value)
    return tomlkit.item(value.item() if isinstance(value, np.generic) else value)


def zpk_values(transfer: Transfer) -> dict[str, object]:
    """Return a transfer function as {"form": "zpk", "gain", "zeros", "poles"}, roots in rad/s as pairs [real,
    imaginary].
    """
    zeros, poles = (
        [[float(root.real), float(root.imag)] for root in roots] for roots in (transfer.zeros, transfer.poles)
    )
    return {"form": "zpk", "gain": transfer.gain, "zeros": zeros, "poles": poles}


def _table(values: Mapping[str, object], holds_tables_alone: bool = False) -> Table:
    """Return a mapping as TOML table; `holds_tables_alone` leaves out the table's heading, as all values are tables."""
    table = tomlkit.table(is_super_table=holds_tables_alone)
    for key, value in _order_values(values):
        table.add(key, toml_item(value))
    return table


def _array(values: Sequence[object] | npt.NDArray[np.generic]) -> Array:
    """Return a list as TOML array, with a line for each entry if it is longer than LIST_WIDTH characters."""
    items = [_inline_item(value) for value in values]
    array = tomlkit.array()
    if len(items) > LIST_WIDTH:  # appended one by one they take a time that grows with its square
        array.add_line(*items, indent="", newline=False)
        return array.multiline(True)
    for element in items:
        array.append(element)
    return array.multiline(len(array.as_string()) > LIST_WIDTH)


def _inline_item(value: object) -> Item:
    """Return a value in a list or an inline table as TOML item: mappings inline."""
    if isinstance(value, Mapping):
        table = tomlkit.inline_table()
        for key, entry in value.items():
            table.append(key, _inline_item(entry))
        return table
    return _array(value) if isinstance(value, list | tuple | np.ndarray) else toml_item(value)


def _order_values(values: Mapping[str, object]) -> list[tuple[str, object]]:
    """Return (key, value) pairs with plain values before tables: TOML cannot return from a table to its parent."""
    return sorted(values.items(), key=lambda entry: _is_table(entry[1]))


def _is_table(value: object) -> bool:
    """Whether a value is written as one or more tables with headings."""
    return isinstance(value, Mapping | AoT) or _is_tables(value)


def _is_tables(value: object) -> TypeGuard[Sequence[Mapping[str, object]]]:
    """Whether a value is a non-empty list of mappings."""
    return isinstance(value, list | tuple) and bool(value) and all(isinstance(entry, Mapping) for entry in value)
