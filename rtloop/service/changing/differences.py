"""Differences of an axis before and after a change, in words: `controller.gain 0.016 → 0.012`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rtloop.configuration.axis import AxisOptions

MOST = 3
"""Differences that are written out; the others are counted."""


def differences(before: AxisOptions, after: AxisOptions) -> str:
    """Keys that differ, each with its value before and after; empty where none does."""
    tables = before.model_dump(mode="json"), after.model_dump(mode="json")
    texts = [text for section in tables[0] for text in _of_section(section, tables[0][section], tables[1][section])]
    omitted_text = f", and {len(texts) - MOST} more" if len(texts) > MOST else ""
    return ", ".join(texts[:MOST]) + omitted_text


def _of_section(section: str, before: Any, after: Any) -> Iterator[str]:
    """Texts of one section; a law of another kind has keys of its own, which are not compared."""
    if before == after:
        return
    if not (isinstance(before, dict) and isinstance(after, dict)):
        yield f"{section} {_shown(before)} → {_shown(after)}"
    elif before.get("kind") != after.get("kind"):
        yield f"{section} {before.get('kind')} → {after.get('kind')}"
    else:
        for key in before | after:
            old, new = before.get(key), after.get(key)
            if old == new:
                continue
            is_long = isinstance(old, list | dict) or isinstance(new, list | dict)
            yield f"{section}.{key} " + ("changed" if is_long else f"{_shown(old)} → {_shown(new)}")


def _shown(value: Any) -> str:
    """A value in few characters."""
    if isinstance(value, float | int) and not isinstance(value, bool):
        return f"{value:.6g}"
    return "none" if value is None else "a table" if isinstance(value, dict) else str(value)
