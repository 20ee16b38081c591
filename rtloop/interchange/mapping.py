"""Mapping of a file's column to a signal, with the factor to the signal's unit.

    x_drive_v = "Piezo Out [mV] * 20"                 column, its unit, an amplifier's gain
    x_position_um = "Sensor [V] * 2.5 µm/V - 3 µm"    a sensor's sensitivity, and an offset of the signal

A column is found by its name, with or without its unit, in any case, or by the end of its path. A unit in brackets
takes precedence over the file's.
"""

from __future__ import annotations

import difflib
import re
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple
from unicodedata import normalize

from rtloop.foundation.arrays import Real
from rtloop.interchange.formats.table import Reading, Table, UnreadableData, ask
from rtloop.interchange.names import name_without_unit, split_unit, unit_in_name
from rtloop.interchange.units import UnknownUnit, factor_between, scale_values
from rtloop.recording.columns import signal_unit
from rtloop.signals import AXIS_SIGNALS, COMMON_SIGNALS, DRIVE

FIRST_AXIS = "x"
MAX_SUGGESTIONS = 3
"""Number of similar columns listed where one is not found."""
MAX_NAME_CHARACTERS = 90
LARGEST_FACTOR = 1e99
ZERO = re.compile(r"[+-]?[0.]+([eE][+-]?\d+)?")
"""A number of which all digits are 0; float reads 1e-400 as 0, too."""
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_SOURCE = re.compile(
    r"(?P<column>.+?)(?:\s*\[(?P<unit>[^\[\]]*)\])?"
    rf"(?:\s+\*\s*(?P<factor>{_NUMBER})(?:\s*(?P<by>[^\s\d]\S*))?)?"
    rf"(?:\s+(?P<sign>[-+])\s*(?P<offset>{_NUMBER})(?:\s*(?P<of>[^\s\d]\S*))?)?\s*"
)
_RESERVED_NAME_PREFIX = "file_"


class MappedColumn(NamedTuple):
    """A file's column as a signal: its values times `factor`, plus `offset`, are in `unit`.

    `description` is the mapping as text.
    """

    name: str
    factor: Fraction
    offset: float
    unit: str
    description: str
    assumption: str | None
    """Assumption made about its unit; None without one."""

    def values(self, table: Table) -> Real:
        """Return the signal, (rows,), computed from the table's column."""
        values = scale_values(table.columns[self.name], self.factor)
        return values + self.offset if self.offset else values


def map_column(table: Table, path: Path, signal: str, source: str) -> MappedColumn:
    """Return the column for `signal` by the mapping `source`, such as `Sensor [V] * 2.5 µm/V - 3 µm`.

    A `signal` without a known unit gets the unit of the column, or of its product with a sensitivity. A column without
    a unit counts as in the unit that the mapping needs; `assumption` says so, and also if the unit in `source` differs
    from the file's. Raises UnreadableData if the column is missing or ambiguous, a unit is unknown or cannot be
    converted to the signal's, or the factor is too large or too small.
    """
    match = None if source in table.columns else _SOURCE.fullmatch(source)
    parts = match.groupdict() if match else {"unit": split_unit(source)[1]}
    name = find_column(table, path, parts.get("column") or source)
    sensitivity_unit, target = parts.get("by") or "", signal_unit(signal)
    in_file = column_unit(table, name)
    source_unit = parts.get("unit") or require_one_unit(table, path, name, signal)
    unit = source_unit or (sensitivity_unit.partition("/")[2] if sensitivity_unit else target)
    result_unit = target or _product_unit(unit, sensitivity_unit)
    try:
        factor = factor_between(unit, target, sensitivity_unit) if target else Fraction(1)
        factor *= _exact_factor(parts.get("factor") or "1")
        offset = float(parts.get("offset") or 0) * (-1 if parts.get("sign") == "-" else 1)
        if (offset_unit := parts.get("of") or result_unit) != result_unit:
            offset *= float(factor_between(offset_unit, result_unit))
    except UnknownUnit as fault:
        raise UnreadableData(
            f"{path}: {signal} from column {name!r}: {fault}; write the unit in brackets, and a factor after a star: "
            f'"{name_without_unit(name)} [V] * 2.5 µm/V"'
        ) from None
    except ValueError as fault:
        raise UnreadableData(f"{path}: {signal} from column {name!r}: {fault}") from None
    assumption = None
    if unit and not source_unit:
        assumption = f"{signal}: column {name!r} has no known unit; {unit} is assumed"
    elif in_file and in_file != source_unit:
        assumption = f"{signal}: column {name!r} has the unit {in_file} in the file; {unit} is used"
    return MappedColumn(name, factor, offset, result_unit, _describe_mapping(name, unit, parts), assumption)


def _exact_factor(text: str) -> Fraction:
    """Return the number that a text states, exactly.

    Raises ValueError for a magnitude above LARGEST_FACTOR or below its reciprocal; 0 is allowed.
    """
    magnitude = abs(float(text))  # Fraction alone would compute all digits of 1e999999999.
    is_zero = ZERO.fullmatch(text) is not None
    if not is_zero and not 1 / LARGEST_FACTOR <= magnitude <= LARGEST_FACTOR:
        raise ValueError(f"factor {text}; allowed: 0, or a magnitude from {1 / LARGEST_FACTOR:g} to {LARGEST_FACTOR:g}")
    return Fraction(0) if is_zero else Fraction(text)


def _product_unit(unit: str, sensitivity_unit: str) -> str:
    """Return the unit of values in `unit` times a factor in `sensitivity_unit`: K for V and K/V.

    Either may be "", for a number without a unit.
    """
    numerator, slash, denominator = sensitivity_unit.partition("/")
    if not sensitivity_unit or unit == denominator:
        return numerator or unit
    unit_numerator, unit_slash, unit_denominator = unit.partition("/")
    return f"{unit_numerator}·{numerator}{unit_slash}{unit_denominator}{slash}{denominator}"


def _describe_mapping(name: str, unit: str, parts: dict[str, str | None]) -> str:
    """Return a column's mapping as text, such as "force [N] * 0.5 µm/N + 3 µm".

    `name` and `unit` are those of the file's column; `parts` may have factor, by (its unit), sign, offset and
    of (its unit), the groups of _SOURCE; {} for a mere name.
    """
    text = f"{name_without_unit(name)} [{unit}]" if unit else name
    if parts.get("factor"):
        text += f" * {parts['factor']} {parts.get('by') or ''}".rstrip()
    if parts.get("offset"):
        text += f" {parts['sign']} {parts['offset']} {parts.get('of') or ''}".rstrip()
    return text


def find_column(table: Table, path: Path, name_or_path: str) -> str:
    """Return the name of the file's column with this name or end of a path; case and unit do not matter.

    An equal name has priority over a similar one, and a name over the end of a path. Raises UnreadableData for none or
    several.
    """
    if name_or_path in table.columns:
        return name_or_path
    rules = (
        lambda name: _normalised_name(name) == _normalised_name(name_or_path),
        lambda name: _normalised_path(name).endswith("/" + _normalised_path(name_or_path)),
    )
    for rule in rules:
        matches = [name for name in table.columns if rule(name)]
        if len(matches) == 1:
            return matches[0]
        if matches:
            raise UnreadableData(
                f"{path}: column {name_or_path!r} is ambiguous; give the whole name, one of: {_quoted_list(matches)}"
            )
    similar = (
        difflib.get_close_matches(name_or_path, list(table.columns), MAX_SUGGESTIONS, 0.4)
        or list(table.columns)[: 4 * MAX_SUGGESTIONS]
    )
    left_out = f" (left out: {table.about['left out']})" if "left out" in table.about else ""
    raise UnreadableData(
        f"{path}: no column {name_or_path!r}; the columns of the file include {_quoted_list(similar)}{left_out}"
    )


def column_unit(table: Table, name: str) -> str | None:
    """Return the unit of a column in the file; None without one.

    It is the unit that `table` states, or else the unit in the name, as in "drive [mV]", "drive in mV" or "drive_mV".
    """
    return table.units.get(name) or unit_in_name(name)


def require_one_unit(table: Table, path: Path, name: str, signal: str) -> str | None:
    """Return the unit in the file of the column for `signal`, "" for the clock.

    Raises AmbiguousData if its name has another one than the file states.
    """
    stated, named = table.units.get(name), split_unit(name)[1]
    try:
        agree = not stated or not named or factor_between(stated, named) == 1
    except UnknownUnit:
        agree = False
    if not agree:
        plain = name_without_unit(name)
        readings = [
            Reading(f'--map "{signal}={plain} [{unit}]"' if signal else f"--time-unit {unit}", f"in {unit}")
            for unit in (named, stated)
        ]
        raise ask(path, f"column {name!r} has the unit {named} in its name, and {stated} beside it", *readings)
    return column_unit(table, name)


def signal_name(text: str) -> str:
    """Return `x_drive_v` for `drive_v`, and likewise x_NAME for the name of any other signal of an axis.

    Any other text is returned unchanged.
    """
    return f"{FIRST_AXIS}_{text}" if text in {signal.name for signal in AXIS_SIGNALS} else text


def default_signal_name(column: str) -> str:
    """Return a column's name in a recording: without its unit, of ASCII letters, digits and underscores.

    A long name loses its beginning: the last MAX_NAME_CHARACTERS stay. The prefix column_ is added to a name that
    does not begin with a letter, `file_` to the name of a signal that every recording has, such as tick.
    """
    plain = (
        normalize("NFKD", name_without_unit(column).replace("µ", "u").replace("ß", "ss"))
        .encode("ascii", "ignore")
        .decode()
    )
    words = re.sub(r"[^A-Za-z0-9]+", "_", plain).strip("_")[-MAX_NAME_CHARACTERS:].strip("_")
    name = words if words[:1].isalpha() else f"column_{words}"
    return _RESERVED_NAME_PREFIX + name if name in {signal.name for signal in COMMON_SIGNALS} else name


def axis_names(signals: list[str]) -> list[str]:
    """Return the names of the axes to which signals belong, each once, in the order of `signals`: x for `x_drive_v`.

    `x_true_position_um` belongs to an axis x_true if this axis has a drive signal or there is no axis x, else to x.
    """
    candidates = [
        name.removesuffix(f"_{signal.name}")
        for name in signals
        for signal in AXIS_SIGNALS
        if name.endswith(f"_{signal.name}")
    ]
    axes = list(dict.fromkeys(candidates))
    axes_with_drive = {axis for axis in axes if f"{axis}_{AXIS_SIGNALS[DRIVE].name}" in signals}
    return [
        axis
        for axis in axes
        if axis in axes_with_drive or not any(axis.startswith(f"{other_axis}_") for other_axis in axes)
    ]


def _normalised_name(name: str) -> str:
    """Return a name in lower case (casefold), without its unit and the quotes and blanks around it."""
    return name_without_unit(name).strip(" \"'").casefold()


def _normalised_path(name: str) -> str:
    """Return a normalised name without quotes, with slashes in place of the dots and backslashes of its path."""
    return re.sub(r"[\\./]+", "/", _normalised_name(name).replace('"', "").strip("/"))


def _quoted_list(names: list[str]) -> str:
    """Return the names as `repr` quotes them, separated by commas."""
    return ", ".join(map(repr, names))
