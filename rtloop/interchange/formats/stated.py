"""What the text above a table states about it: the sample rate, ticks of a clock, names of columns, scales of codes."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from rtloop.interchange.formats.cells import parse_cell
from rtloop.interchange.names import is_time_unit, split_unit
from rtloop.interchange.units import UnknownUnit, factor_between

_INTERVAL = re.compile(
    r"x?[ _]?inc(rement)?|x[ _]?increment|delta[ _]?(x|t|time)|dt|(wf|t)[ _]?inc(rement)?|wf_increment|d[ _]?time|Δt|"
    r"(time[ _]?)?(sample|sampling|scan|time)[ _.]?(interval|period|time|step|increment|resolution)|"
    r"interval|horizontal[ _]?(resolution|interval)|h[ _]?resolution|abtast(intervall|zeit|periode)|"
    r"timestep|tsample|ts|t_s"
)
_RATE = re.compile(
    r"fs|f_s|f[ _]?sample|f[ _]?samp|sfreq|sps|srate|rate|(sample|sampling|scan|acquisition|acq|data|daq|logging)[ _.]?"
    r"(rate|frequency|freq)|(sample|sampling)[ _]?rate[ _]?hz|abtast(rate|frequenz)|"
    r"samples?[ _]?(per|/)[ _]?s(ec(ond)?)?"
)
_TICKS = re.compile(
    r"clock[ _]?base|time[ _]?base[ _]?(frequency|hz)|tick[ _]?(rate|frequency)|ticks?[ _]?per[ _]?second"
)
_SCALE = re.compile(
    r"(scale|scaling|gain|multiplier|factor|slope|sensitivity)([ _]?factor)?|y[ _]?(mult|inc(rement)?)|"
    r"volts?[ _]?per[ _]?(lsb|count|code|bit)|lsb|offset|y[ _]?(off(set)?|zero|org|origin)|conversion([ _]?factor)?"
)
NAME_KEYS = frozenset(
    ["name", "names", "tracename", "trace name", "signal", "signal name", "channel name", "label", "long name"]
)
UNIT_KEYS = frozenset(["unit", "units", "vunit", "y_unit_label", "yunit", "yunits", "vertical units", "y units"])
_NUMBERED_NAME = re.compile(r"name[ _]?(\d+)")
_PAIR = re.compile(r"(?P<key>[^=:;\t,\"]{1,60}?)\s*(?P<sign>=|:|\t|;|,)\s*(?P<values>.*\S)")
_RATE_UNIT = re.compile(r"([kMG]?)(?:Hz|S/s|Sa/s|sps|samples?/s(?:ec)?|1/s|SPS)", re.IGNORECASE)
_PREFIX = {"": 1.0, "k": 1e3, "m": 1e6, "g": 1e9}


class Statement(NamedTuple):
    """A line or cell that states a value: its words, line (from 1), key without unit in lower case, unit, values."""

    line: int
    text: str
    key: str
    unit: str
    values: tuple[str, ...]

    def numbers(self, decimal: str) -> list[tuple[float, str]]:
        """Return each number among the values, with the unit behind it or that of the key."""
        found = []
        for value in self.values:
            text = re.sub(r"^[A-Za-z]\w*\s*:\s*", "", value)
            if match := parse_value(text, decimal):
                found.append((match[0], match[1] or self.unit))
        return found


class Rate(NamedTuple):
    """A rate in Hz, and the words that state it."""

    hz: float
    source: str


def read_statement(line: int, text: str) -> Statement | None:
    """Return what a line such as "Sample Interval,1e-4", "# dt = 0.1 ms" or "Fs: 10 kHz" states; None for others."""
    match = _PAIR.fullmatch(text.strip())
    if match is None:
        return None
    # Behind a colon or an equals sign, a comma may stand in a number: Rate: 10,000 Hz.
    is_number = match["sign"] in ":=" and parse_value(match["values"], ".") is not None
    values = [match["values"]] if is_number else re.split(r"\s*[;\t,]\s*", match["values"])
    return statement(line, match["key"], values)


def statement(line: int, key: str, values: Iterable[str]) -> Statement:
    """Return the statement of a key, such as "dt [ms]", with its values."""
    values = tuple(text for value in values if (text := str(value).strip(" \"'")))
    bare, unit = split_unit(key.strip(" \"':"))
    rate_unit = re.fullmatch(rf"(.+?)\s*[\[(]\s*({_RATE_UNIT.pattern})\s*[\])]", key.strip(), re.IGNORECASE)
    if rate_unit:
        bare, unit = rate_unit[1], rate_unit[2]
    return Statement(line, f"{key.strip()} {' '.join(values[:3])}"[:80], bare.strip().casefold(), unit or "", values)


def stated_rates(statements: Iterable[Statement], decimal: str = ".") -> list[Rate]:
    """Return the sample rates that are stated, each once; an interval without a unit is in s, a rate in Hz."""
    rates: list[Rate] = []
    for entry in statements:
        numbers = entry.numbers(decimal)
        if len(numbers) == 2 and parse_cell(entry.values[1], decimal) is None and not numbers[0][1]:
            numbers = numbers[:1]
        found: list[float] = []
        if _RATE.fullmatch(entry.key):
            unit_cell = next((value for value in entry.values if _RATE_UNIT.fullmatch(value)), "")
            found = [value * _rate_factor(unit or unit_cell) for value, unit in numbers]
        elif _INTERVAL.fullmatch(entry.key):
            unit_cell = next((value for value in entry.values if is_time_unit(value)), "s")
            factors = [_interval_factor(unit or unit_cell) for _, unit in numbers]
            found = [1 / (value * f) if value * f > 0 else 0.0 for (value, _), f in zip(numbers, factors, strict=True)]
        rates += [Rate(float(f"{hz:.12g}"), entry.text) for hz in found if 1e-3 <= hz < 1e12]
    unique: list[Rate] = []
    for rate in rates:
        if not any(abs(rate.hz - other.hz) <= 1e-4 * other.hz for other in unique):
            unique.append(rate)
    return unique


def stated_ticks(statements: Iterable[Statement], decimal: str = ".") -> float | None:
    """Return the rate in Hz of a clock whose ticks the times count; None where none is stated."""
    values = [n for entry in statements if _TICKS.fullmatch(entry.key) for n in entry.numbers(decimal)]
    return next((value * _rate_factor(unit) for value, unit in values if value > 0), None)


def numbered_names(statements: Iterable[Statement]) -> dict[int, str]:
    """Return the names of columns, by their place from 0, that lines such as "NAME0 = Voltage" state."""
    entries = [
        (match, entry) for entry in statements if (match := _NUMBERED_NAME.fullmatch(entry.key)) and entry.values
    ]
    first = min((int(match[1]) for match, _ in entries), default=0)
    return {int(match[1]) - first: " ".join(entry.values) for match, entry in entries}


def scale_statements(statements: Iterable[Statement], decimal: str = ".") -> list[Statement]:
    """Return the statements of a scale, gain or offset that changes a number."""
    return [
        entry
        for entry in statements
        if _SCALE.fullmatch(entry.key)
        and any(
            value != (0.0 if "off" in entry.key or "zero" in entry.key else 1.0) for value, _ in entry.numbers(decimal)
        )
    ]


def keyed_row(statements: Iterable[Statement], keys: frozenset[str], columns: int) -> tuple[str, ...]:
    """Return the values of the last statement under one of the keys that has one for each column; () without one."""
    rows = [entry.values for entry in statements if entry.key in keys and len(entry.values) == columns]
    return rows[-1] if rows else ()


def parameters(values: Mapping[str, object]) -> list[Statement]:
    """Return the single numbers of a file by name, such as a variable `Fs` of a MAT file, as statements."""
    return [statement(0, name.rpartition("/")[2], [str(value)]) for name, value in values.items()]


def parse_value(text: str, decimal: str) -> tuple[float, str] | None:
    """Return a number and the unit behind it, also a unit of rates; the other decimal sign is tried last."""
    for sign in (decimal, *{".", ","} - {decimal}):
        if match := _with_rate_unit(text, sign) or parse_cell(text, sign):
            return match[0], match[1]
    return None


def _with_rate_unit(text: str, decimal: str) -> tuple[float, str] | None:
    match = re.fullmatch(rf"(\S+?)\s*({_RATE_UNIT.pattern})", text, re.IGNORECASE)
    cell = parse_cell(match[1], decimal) if match else None
    return (cell.value, match[2]) if match and cell else None


def _rate_factor(unit: str) -> float:
    match = _RATE_UNIT.fullmatch(unit)
    return _PREFIX[match[1].lower()] if match else 1.0


def _interval_factor(unit: str) -> float:
    try:
        return float(factor_between(unit, "s"))
    except UnknownUnit:
        return 0.0
