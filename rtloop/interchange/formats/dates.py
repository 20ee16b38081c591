"""Dates and times of day in a text table, as whole ns."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import pandas

_KINDS = {
    "date": re.compile(r"\d{4}[-/]\d\d[-/]\d\d[T ]+\d\d:\d\d(:\d\d([.,]\d+)?)?\s*(Z|UTC|[-+]\d\d:?\d\d)?"),
    "day first": re.compile(r"\d{1,2}\.\d{1,2}\.\d{2,4}[ T,]+\d{1,2}:\d\d(:\d\d([.,]\d+)?)?"),
    "slashes": re.compile(r"\d{1,2}/\d{1,2}/\d{2,4}[ T,]+\d{1,2}:\d\d(:\d\d([.,:]\d+)?)?( ?[AP]M)?"),
    "time of day": re.compile(r"\d{1,2}:\d\d:\d\d([.,:]\d+)?( ?[AP]M)?"),
    "minutes": re.compile(r"\d{1,3}:\d\d[.,]\d+"),
}
DAY_NS = 86_400 * 10**9


def date_kind(text: str) -> str | None:
    """Return the kind of a date with a time, or of a time of day; None for any other text."""
    if ":" not in text:
        return None
    return next((kind for kind, pattern in _KINDS.items() if pattern.fullmatch(text)), None)


def dates_ns(text: pandas.Series, kind: str, first: str | None = None) -> npt.NDArray[np.int64]:
    """Return dates of a kind in ns, int64, from any origin; the least int64 for a field without one.

    A date without a time zone counts as UTC. `first`, day or month, is what a date with slashes begins with.
    """
    import pandas

    text = text.str.replace(r"(\d:\d\d:\d\d):(\d+)$", r"\1.\2", regex=True)  # 12:30:01:500 has ms at its end
    if kind == "minutes":
        text = "0:" + text
    if kind in ("time of day", "minutes") and not text.str.contains("M", case=False).any():
        spans = pandas.to_timedelta(text.str.replace(",", ".", regex=False), errors="coerce")
        return spans.to_numpy("timedelta64[ns]").astype(np.int64)
    if kind == "date":
        text = text.str.replace(",", ".", regex=False).str.replace("/", "-", regex=False)
        dates = pandas.to_datetime(text, format="ISO8601", utc=True, errors="coerce")
    else:
        is_day_first = kind == "day first" or (_is_day_first(text) if first is None else first == "day")
        text = text.str.replace(r",(\d+)$", r".\1", regex=True)
        dates = pandas.to_datetime(text, format="mixed", dayfirst=is_day_first, utc=True, errors="coerce")
    return dates.dt.tz_localize(None).to_numpy("datetime64[ns]").astype(np.int64)


def _is_day_first(text: pandas.Series) -> bool:
    """Whether the first number of a date such as 24/12/2024 exceeds 12 in some row."""
    return bool((text.str.extract(r"^(\d{1,2})/", expand=False).astype(float) > 12).any())


def has_one_order(text: pandas.Series) -> bool:
    """Whether dates with slashes are on one day, or a number above 12 shows which is the day."""
    parts = text.str.extract(r"^(\d{1,2})/(\d{1,2})/").astype(float)
    return bool((parts > 12).to_numpy().any() or len(parts.drop_duplicates()) == 1)


def unroll_days(values: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return times of day that go on after midnight."""
    is_next_day = np.diff(values, prepend=values[:1]) < -DAY_NS // 2
    return values + DAY_NS * np.cumsum(is_next_day)
