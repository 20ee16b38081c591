"""Keys of a configuration by their dotted path, such as `driver.plant.sensor.noise_um` or `axis.x.limits.drive_v`.

A list of tables with names is entered by name, any other list by a number from 0.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from rtloop.configuration.file import Configuration
from rtloop.foundation.options import Options

DRIVER = "driver."
"""Beginning of the keys that change the driver alone."""
FIXED_KEYS = ("driver.kind", "driver.channels", "loop.mode", "loop.enable_input", "loop.hold_", "schedule")
"""Beginnings of keys that a campaign sets, or on which other parts of a configuration depend."""


def is_rig_key(key: str) -> bool:
    """Whether a key changes the driver's options alone; False for `driver.kind` and `driver.channels`, too."""
    return key.startswith(DRIVER) and not key.startswith(FIXED_KEYS)


def replace_values(tables: Mapping[str, object], values: Mapping[str, object]) -> dict[str, object]:
    """Return a deep copy of a configuration's tables in which each dotted key of `values` has its value.

    Missing tables are made. Raises ValueError for a path through a value that is neither a table nor a list, and for an
    entry, by name or number, that a list lacks.
    """
    changed = copy.deepcopy(dict(tables))
    for key, value in values.items():
        _set_value(changed, key, value)
    return changed


def _set_value(tables: dict[str, object], key: str, value: object) -> None:
    """Set the value of one key in place; raises ValueError as `replace_values` does."""
    node: object = tables
    *parents, last = key.split(".")
    for part in parents:
        if isinstance(node, dict) and part not in node:
            node[part] = {}
        node = _step(node, part, key)
    if isinstance(node, list):
        node[_list_index(node, last, key)] = value
    elif isinstance(node, dict):
        node[last] = value
    else:
        raise ValueError(
            f"{key}: {last!r} follows the value {node!r}, which is neither a table nor a list; end the key before "
            f"{last!r}"
        )


def _step(node: object, part: str, key: str) -> object:
    """Return the entry `part` of a table, which must have it, or of a list, by name or number, on the path `key`.

    Raises ValueError for a list without it, and for a node that is neither a table nor a list.
    """
    if isinstance(node, dict):
        return node[part]
    if isinstance(node, list):
        return node[_list_index(node, part, key)]
    raise ValueError(
        f"{key}: {part!r} follows the value {node!r}, which is neither a table nor a list; end the key before {part!r}"
    )


def _list_index(entries: list[object], part: str, key: str) -> int:
    """Return the index of an entry, by its name or its number, from 0. Raises ValueError if the list lacks it."""
    names = [entry.get("name") for entry in entries if isinstance(entry, dict)]
    if part in names:
        return names.index(part)
    if part.isdecimal() and int(part) < len(entries):
        return int(part)
    allowed = ", ".join(map(str, filter(None, names))) or f"0 … {len(entries) - 1}"
    raise ValueError(f"{key}: no entry {part!r}; allowed: {allowed}")


def option_value(configuration: Configuration, driver_options: Options, key: str) -> Any:
    """Return the value of a dotted key, such as `axis.x.limits.drive_v`, from the checked options, defaults included.

    A key of the driver is read from `driver_options`. Raises ValueError for a key that no option has.
    """
    section, _, path = key.partition(".")
    if section == "driver":
        return _attribute(driver_options, path, key)
    if section == "axis":
        name, _, path = path.partition(".")
        axes = {axis.name: axis for axis in configuration.axes}
        if name not in axes:
            raise ValueError(f"{key}: there is no axis {name!r}; allowed: {', '.join(axes)}")
        return _attribute(axes[name], path, key)
    sections = {"loop": configuration.loop, "recording": configuration.recording, "service": configuration.service}
    if section not in sections:
        raise ValueError(f"{key}: unknown key; allowed: keys of driver, axis, {', '.join(sections)}")
    return _attribute(sections[section], path, key)


def _attribute(options: object, path: str, key: str) -> object:
    """Return the value at the dotted `path` below an options object; `key` is the whole key, for messages.

    Raises ValueError for a part that does not exist.
    """
    value = options
    for part in path.split("."):
        if isinstance(value, tuple) and part.isdecimal() and int(part) < len(value):
            value = value[int(part)]
        elif isinstance(value, Mapping) and part in value:
            value = value[part]
        elif isinstance(value, Options) and part in type(value).model_fields:
            value = getattr(value, part)
        else:
            raise ValueError(f"{key}: there is no key {part!r}{_choices_text(value)}")
    return value


def _choices_text(value: object) -> str:
    """Return "; allowed: …" with the fields of Options, the keys of a table or the indices of a tuple.

    Return "; the list is empty" for an empty tuple, "" for an empty table and for every other value.
    """
    names = list(type(value).model_fields) if isinstance(value, Options) else []
    names = list(value) if isinstance(value, Mapping) else names
    if isinstance(value, tuple):
        return f"; allowed: 0 … {len(value) - 1}" if value else "; the list is empty"
    return f"; allowed: {', '.join(names)}" if names else ""
