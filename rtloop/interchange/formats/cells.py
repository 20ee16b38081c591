"""A cell of a text table: a number in its notation, with or without a unit, or a marker of a missing value."""

from __future__ import annotations

import re
from collections.abc import Collection
from functools import lru_cache
from typing import NamedTuple

from rtloop.interchange.units import is_unit

NO_NUMBER = ("", "nan", "-nan", "na", "n/a", "null", "none", "#n/a")
"""Texts in place of a missing number, as scripts and spreadsheets write them."""
NO_MARKER = "none"
INFINITE = ("inf", "-inf", "+inf", "infinity", "-infinity")
MARKERS = frozenset(
    [
        "#na",
        "#nv",
        "#div/0!",
        "#num!",
        "#value!",
        "#ref!",
        "#null!",
        "#name?",
        "1.#qnan",
        "-1.#qnan",
        "1.#ind",
        "-1.#ind",
        "1.#inf",
        "-1.#inf",
        "1.#snan",
        "∞",
        "+∞",
        "-∞",
        "−∞",
        "±∞",
        "over",
        "+over",
        "-over",
        "overrange",
        "over-range",
        "over range",
        "overload",
        "ovld",
        "+ovld",
        "-ovld",
        "ovl",
        "overld",
        "overflow",
        "+overflow",
        "-overflow",
        "ol",
        "+ol",
        "-ol",
        "o.l",
        "o.l.",
        "under",
        "underrange",
        "under-range",
        "under range",
        "underflow",
        "out of range",
        "invalid",
        "bad",
        "fffffff",
        "+fffffff",
        "-fffffff",
        "nodata",
        "no-data",
        "no data",
        "no value",
        "missing",
        "not a number",
        "nil",
        "undef",
        "undefined",
    ]
)
"""Texts in place of a reading that an instrument could not take: overrange, underrange, no signal."""
_FILLING = re.compile(r"[-–—−_*?#.]+")
"""Dashes and the like: a display without a reading."""
_GROUPING = {".": ",'’ \u00a0\u202f\u2009", ",": ".'’ \u00a0\u202f\u2009"}
"""Characters between thousands, by the decimal sign."""
_NUMBER = {
    decimal: re.compile(
        rf"[-+−–]?(?:[1-9]\d{{0,2}}(?:[{group}]\d{{3}})+(?:{re.escape(decimal)}\d*)?|\d+{re.escape(decimal)}?\d*"
        rf"|{re.escape(decimal)}\d+)(?:[eEdD][-+−–]?\d+)?"
    )
    for decimal, group in _GROUPING.items()
}
_SIGNS = {"−": "-", "–": "-", "d": "e", "D": "e"}
_SPELLING = {
    decimal: str.maketrans(dict.fromkeys(group) | _SIGNS | {decimal: "."}) for decimal, group in _GROUPING.items()
}
"""Python's spelling of a number, by the decimal sign."""


class Cell(NamedTuple):
    """A cell's number, NaN for a missing one, and the unit behind it, "" without one."""

    value: float
    unit: str = ""


@lru_cache(1 << 16)
def parse_cell(text: str, decimal: str) -> Cell | None:
    """Return the number in a cell, without blanks around it, by its decimal sign; None for any other text."""
    match = _NUMBER[decimal].match(text)
    if match is None:
        return Cell(float(text)) if text.lower() in INFINITE else None
    unit = text[match.end() :].strip()
    if unit and not is_unit(unit):
        return None
    return Cell(float(match[0].translate(_SPELLING[decimal])), unit)


def is_missing(text: str, missing: Collection[str]) -> bool:
    """Whether a cell stands for a missing value: empty, in the user's list `missing`, or a usual marker.

    With "none" in the list, the usual markers count for nothing.
    """
    if not text or text in missing:
        return True
    if NO_MARKER in missing:
        return False
    lower = text.lower()
    return lower in NO_NUMBER or lower in MARKERS or _FILLING.fullmatch(text) is not None


def is_value(text: str, decimal: str, missing: Collection[str] = ()) -> bool:
    """Whether a cell is a number, or stands for a missing one."""
    return parse_cell(text, decimal) is not None or is_missing(text, missing)
