"""TOML text from plain values: numbers are written so that reading them gives the same bits."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt


def section(name: str, values: Mapping[str, Any], comments: Sequence[str] = ()) -> str:
    """`[name]` with its keys, below comment lines; tables within follow as sections, lists of tables as [[…]]."""
    lines = [f"# {comment}\n" for comment in comments]
    inner = {key: value for key, value in values.items() if isinstance(value, Mapping) or _is_tables(value)}
    own = {key: value for key, value in values.items() if key not in inner}
    if name and (own or not inner):
        lines.append(f"[{name}]\n")
    lines += [f"{key} = {text(value)}\n" for key, value in own.items()]
    for key, value in inner.items():
        path = f"{name}.{key}" if name else key
        if isinstance(value, Mapping):
            lines.append("\n" + section(path, value))
            continue
        for item in value:
            lines.append("\n" + section(path, item).replace(f"[{path}]", f"[[{path}]]", 1))
    return "".join(lines).replace("\n\n\n", "\n\n")


def text(value: Any) -> str:
    """One value. Inline tables for mappings within lists and values."""
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if isinstance(value, int | np.integer):
        return str(int(value))
    if isinstance(value, float | np.floating):
        return repr(float(value))
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {text(item)}" for key, item in value.items()) + " }"
    items = [text(item) for item in value]
    joined = ", ".join(items)
    return f"[{joined}]" if len(joined) < 90 else "[\n" + "".join(f"    {item},\n" for item in items) + "]"


def roots(values: npt.NDArray[np.complex128]) -> list[list[float]]:
    """Complex numbers as [real, imaginary]."""
    return [[float(value.real), float(value.imag)] for value in values]


def _is_tables(value: Any) -> bool:
    return isinstance(value, list | tuple) and bool(value) and all(isinstance(item, Mapping) for item in value)
