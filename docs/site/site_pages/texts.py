"""Texts of the code as Markdown: strings below fields, cells of tables, units of names."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Sequence

UNITS = {
    "um_per_v": "µm/V",
    "v_per_um": "V/µm",
    "v_per_s": "V/s",
    "per_s": "1/s",
    "per_v": "µm/V",
    "um": "µm",
    "v": "V",
    "hz": "Hz",
    "s": "s",
    "ms": "ms",
    "us": "µs",
    "ns": "ns",
    "deg": "°",
    "ticks": "ticks",
    "tick": "tick",
    "percent": "%",
    "mib": "MiB",
    "gib": "GiB",
}
"""Unit by the end of a name; the longest end that fits counts."""


def unit_of(name: str) -> str:
    """Return the unit that the end of a name states, such as "µm" for `position_um`; "" for none."""
    for suffix in sorted(UNITS, key=len, reverse=True):
        if name == suffix or name.endswith(f"_{suffix}"):
            return UNITS[suffix]
    return ""


def own_docstring(owner: type) -> str:
    """Return the docstring of a class itself, without that of a base; "" for none."""
    return inspect.cleandoc(vars(owner).get("__doc__") or "")


def escape(text: str) -> str:
    """Return a docstring as Markdown: outside code, `<`, `*` and `[` are plain characters."""
    parts = re.split(r"(`[^`\n]+`)", text)
    return "".join(
        part if part.startswith("`") else re.sub(r"([*\[\]])", r"\\\1", part).replace("<", "&lt;") for part in parts
    )


def docstring_markdown(text: str) -> str:
    """Return a docstring as Markdown: its examples, from `>>>` to an empty line, are blocks of code."""
    paragraphs = text.split("\n\n")
    return "\n\n".join(
        f"```pycon\n{paragraph}\n```" if paragraph.startswith(">>> ") else escape(paragraph) for paragraph in paragraphs
    )


def cell(text: str) -> str:
    """Return a text as one cell of a table: one line, in which `|` separates nothing."""
    parts = re.split(r"(`[^`]+`)", " ".join(text.split()))
    return "".join(part if part.startswith("`") else part.replace("|", "&#124;") for part in parts)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table with an empty line before and after it; "" without rows."""
    lines = ["| " + " | ".join(cell(value) for value in row) + " |" for row in rows]
    if not lines:
        return ""
    rule = "|" + "---|" * len(head)
    return "\n".join(["", "| " + " | ".join(head) + " |", rule, *lines, ""])


def anchored(name: str, anchor: str) -> str:
    """Return a name as code that is the target of links to `anchor`."""
    return f'<code id="{anchor}">{name}</code>'
