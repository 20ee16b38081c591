"""Meaning of a column's name: the unit in it, and whether it names times or numbers of rows."""

from __future__ import annotations

import re

from rtloop.interchange.units import UnknownUnit, factor_between, is_unit

TIME_NAMES = (
    "deadline_ns", "time", "t", "zeit", "time_s", "timestamp", "tout", "sim_time", "elapsed", "elapsed time",
    "x_value", "time stamp", "datetime", "date/time", "date time", "date_time", "epoch", "unix time", "unixtime",
    "seconds", "milliseconds", "microseconds", "nanoseconds", "msec", "usec", "sec", "secs", "elapsed_time",
    "relative time", "rel. time", "rel time", "relativetime", "absolute time", "abs time", "time axis", "uhrzeit",
    "zeitstempel", "temps", "tiempo", "tempo", "uptime", "clock", "sampletime", "time of day", "stamp",
)  # fmt: skip
"""Usual names of a column of times, without their units, the likeliest first."""
COUNTER_NAMES = frozenset(
    [
        "no",
        "no.",
        "nr",
        "nr.",
        "#",
        "index",
        "idx",
        "sample",
        "samples",
        "sequence",
        "seq",
        "row",
        "rows",
        "record",
        "records",
        "scan",
        "n",
        "i",
        "k",
        "point",
        "points",
        "count",
        "counter",
        "number",
        "line",
        "zeile",
        "lfd",
        "lfd.nr.",
        "lfd. nr.",
        "sample_number",
        "samplenumber",
        "sample number",
        "sample no.",
        "data point",
        "data no.",
    ]
)
"""Usual names and units of a column that numbers the rows."""
_BRACKETED = re.compile(
    r"(.+?)\s*[,_]?\s*(?:\[([^\[\]]*)\]|\(([^()]*)\)|\{([^{}]*)\}|<([^<>]*)>|\s(?:/|in)\s+(\S+)|\s*[,:]\s+(\S+))"
)
_SUFFIX = re.compile(r"(.*[^_])_([A-Za-zµ]+)")


def split_unit(name: str) -> tuple[str, str | None]:
    """Return (name, unit) of `name [unit]`, `name (unit)`, `name / unit`, `name in unit` and the like.

    Returns (whole text, None) where no known unit ends it.
    """
    if (alone := re.fullmatch(r"in (\S+)", name.strip())) and is_unit(alone[1]):
        return name, alone[1]
    match = _BRACKETED.fullmatch(name.strip())
    unit = next(filter(None, match.groups()[1:]), "").strip() if match else ""
    return (match[1], unit) if match and is_unit(unit) else (name, None)


def name_without_unit(name: str) -> str:
    """Return a column's name without the unit at its end, as in "x [mV]", "x (mV)", "x / mV" or "x in mV".

    Any other name, such as "x_mV", is returned unchanged.
    """
    return split_unit(name)[0]


def unit_in_name(name: str) -> str | None:
    """Return the unit in a name, as in "drive [mV]", "drive in mV" or "drive_mV"; None without one."""
    if unit := split_unit(name)[1]:
        return unit
    suffix = _SUFFIX.fullmatch(name)
    return suffix[2] if suffix and suffix[2] != "d" and is_unit(suffix[2]) else None  # x_d is no x in days


def bare_name(name: str) -> str:
    """Return the last part of a path, in lower case, without its unit and the quotes and blanks around it."""
    plain = name_without_unit(name).rpartition("/")[2].strip(" \"'%_#").casefold()
    suffix = _SUFFIX.fullmatch(plain)
    return suffix[1] if suffix and plain not in TIME_NAMES and is_time_unit(suffix[2]) else plain


def is_time_name(name: str) -> bool:
    """Whether a name is one of TIME_NAMES, with or without a unit of time."""
    return bare_name(name) in TIME_NAMES


def is_counter_name(name: str) -> bool:
    """Whether a name or a unit is one of COUNTER_NAMES."""
    return bare_name(name) in COUNTER_NAMES


def is_time_unit(unit: str | None) -> bool:
    """Whether a unit is known and converts to s; False for None and ""."""
    try:
        return bool(unit) and bool(factor_between(unit or "", "s"))
    except UnknownUnit:
        return False
