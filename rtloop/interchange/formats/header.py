"""Names, units and statements in the text above a table, or beside its first rows.

The nearest record with a name for each column has the names. A row of units may follow it. Whatever else stands between
names and numbers is named in a note, or asked about if it may change a number.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from rtloop.interchange.formats.cells import is_missing, parse_cell
from rtloop.interchange.formats.dates import date_kind
from rtloop.interchange.formats.dialect import Grid
from rtloop.interchange.formats.stated import (
    NAME_KEYS,
    UNIT_KEYS,
    Statement,
    keyed_row,
    numbered_names,
    read_statement,
    scale_statements,
    statement,
)
from rtloop.interchange.formats.table import AmbiguousData, Hints, Reading, UnreadableData, ask
from rtloop.interchange.formats.text_source import Record
from rtloop.interchange.names import is_counter_name, is_time_name, split_unit, unit_in_name
from rtloop.interchange.units import is_unit

_COMMENT = re.compile(r"\s*(#|%|//|;)+\s*")
_INVISIBLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b\ufeff]")
"""Characters that a terminal obeys, or shows as nothing."""
_FOLDED_BLANKS = (r"\s{2,}|\t", r"\s+(?![\[(<])", r"\s*[,;]\s*")
"""Separators of names that themselves have blanks, in a table of blanks."""
_QUANTITY = re.compile(r"(\w[\w .]*)\s*/\s*(\S+)")
"""A quantity divided by its unit, as ISO 80000-1 writes it: U/V."""
_UNIT_LABELS = frozenset(["unit", "units", "einheit", "einheiten", "unité", "unités"])
"""Words before a row of units."""
_SHOWN = 60
MOST_SHOWN = 8
NO_NAMES = Reading("--header-row 0", "no column has a name; they are column_1, column_2, …")


class Header(NamedTuple):
    """Names and units ("" without one) of all columns; `unnamed` are those whose names are made up.

    `statements` are what the text states, `notes` sentences for the user.
    """

    names: list[str]
    units: list[str]
    unnamed: list[str]
    statements: list[Statement]
    notes: list[str]


class HeaderReader:
    """Reads the header of a table; `rows` are its first rows, all fields of which are known."""

    def __init__(self, path: Path, grid: Grid, rows: Sequence[Sequence[str]], hints: Hints) -> None:
        """Take the records above the table apart. Reads nothing else."""
        self._path, self._grid, self._rows, self._hints = path, grid, rows, hints
        self._columns = (*grid.dates, *grid.numbers)
        filled = [k for row in rows if len(row) == grid.width for k, field in enumerate(row) if field]
        self._used = max([*self._columns, *filled]) + 1
        """Number of columns up to the last one that holds values or texts."""
        first = [row[0] for row in rows if len(row) == grid.width]
        self._is_counted = first[:2] in (["0", "1"], ["1", "2"])
        self._records = [self._clean(record) for record in grid.above]
        self._notes: list[str] = []

    def read(self) -> Header:
        """Return the header.

        Raises AmbiguousData where the names fit the columns in two ways, or a statement between names and numbers may
        change the numbers; UnreadableData for a `header_row` that is no line above the numbers.
        """
        grid, records = self._grid, self._records
        statements = [entry for record in records if (entry := self._statement(record))] + self._side_block()
        place, units_place = self._find_names()
        names, units = [""] * grid.width, [""] * grid.width
        if units_place is not None:
            label, *fields = records[units_place].fields
            units = self._widen(["" if label.casefold() in _UNIT_LABELS else _unit(label), *map(_unit, fields)])
        if place is not None:
            values = records[units_place].fields[self._used :] if units_place is not None else []
            extra = zip(records[place].fields[self._used :], values, strict=False)
            statements += [statement(records[place].line, name, [value]) for name, value in extra if name and value]
            beyond = [read_statement(records[place].line, name) for name in records[place].fields[self._used :]]
            statements += [entry for entry in beyond if entry]
            names = self._place_names(records[place], has_values=bool(values))
        else:
            for k, (name, unit) in self._stated_names(statements).items():
                names[k], units[k] = name, unit or units[k]
        for k, name in enumerate(names):
            match = _QUANTITY.fullmatch(name)
            if match and not units[k] and is_unit(match[2]):
                units[k] = match[2]
        for columns in (grid.numbers, grid.numbers[1:]):
            for k, unit in zip(columns, keyed_row(statements, UNIT_KEYS, len(columns)), strict=False):
                units[k] = units[k] or _unit(unit)
        unnamed = [f"column_{k + 1}" for k, name in enumerate(names) if not name]
        names = [name or f"column_{k + 1}" for k, name in enumerate(names)]
        return Header(names, units, unnamed, statements, self._notes)

    def _find_names(self) -> tuple[int | None, int | None]:
        """Return the places of the records that hold names and units, each None without one."""
        records = self._records
        if self._hints.header_row is not None:
            return self._given_names(self._hints.header_row)
        units_place: int | None = None
        between: list[Record] = []
        misfit: Record | None = None
        for place in range(len(records) - 1, -1, -1):
            record, above = records[place], records[:place]
            if all(is_missing(field, ()) or set(field) <= set("-=_") for field in record.fields):
                continue
            if units_place is None and self._are_units(record) and any(map(_has_text, above)):
                units_place = place
            elif self._are_names(record, units_place == place + 1):
                others = [other for other in above if self._are_names(other) and not self._are_units(other)]
                if others and self._is_rival(place, units_place, others[-1]):
                    between.append(record)
                    continue
                self._account_for(between, record)
                return place, units_place
            else:
                misfit = record if not between and self._is_misfit(record) else misfit
                between.append(record)
        if misfit is not None:
            raise self._misfit(misfit)
        return None, units_place

    def _given_names(self, line: int) -> tuple[int | None, int | None]:
        records = self._records
        place = next((k for k, record in enumerate(records) if record.line == line), None)
        if place is None and line:
            lines = ", ".join(str(record.line) for record in records) or "none"
            raise UnreadableData(f"{self._path}: --header-row {line}; allowed: 0, or a line above the numbers: {lines}")
        below = len(records) if place is None else place + 1
        return place, below if below < len(records) and self._are_units(records[below]) else None

    def _is_rival(self, place: int, units_place: int | None, other: Record) -> bool:
        """Whether `other`, above the record at `place`, has the names instead of it.

        Raises AmbiguousData where both may have them.
        """
        record = self._records[place]
        if units_place is not None and not self._are_numbered(record):
            return len(record.fields) < self._used <= len(other.fields)
        if self._are_numbered(record) or len(record.fields) < self._used <= len(other.fields):
            return units_place != place + 1
        if place >= 2 and self._are_units(self._records[place - 1]) and other is self._records[place - 2]:
            return True  # names, units, comments
        if any(is_time_name(field) or unit_in_name(field) for field in record.fields):
            return False
        readings = [Reading(f"--header-row {r.line}", f"{_shown(r)!r} are the names") for r in (record, other)]
        raise ask(self._path, "several lines may hold the names", *readings)

    def _account_for(self, between: Sequence[Record], names: Record) -> None:
        """Add a note for each record between names and numbers. Raises AmbiguousData for one that may scale them."""
        if self._are_numbered(names) and not any(map(self._are_units, self._records)):
            first = Reading(f"--header-row {names.line}", f"{_shown(names)!r} are the names of the columns")
            second = Reading(f"--skip-rows {names.line}", "this line is left out")
            raise ask(self._path, f"line {names.line} may hold names or values", first, second)
        lines: list[str] = []
        for record in reversed(between):
            entry = statement(record.line, record.fields[0], record.fields[1:])
            values = [value for value, _ in entry.numbers(self._grid.decimal)]
            if scale_statements([entry], self._grid.decimal) and len(values) >= max(self._used - 1, 1):
                places = enumerate(values, self._used - len(values))
                k, value = next((k, value) for k, value in places if value not in (0.0, 1.0))
                name = names.fields[k] if k < len(names.fields) else f"column_{k + 1}"
                raise ask_for_scale(self._path, entry, name, value, str(record.line))
            lines.append(f"line {record.line}, {_shown(record)!r}")
        if lines:
            self._notes.append(f"left out between names and numbers: {'; '.join(lines[:MOST_SHOWN])}")

    def _place_names(self, record: Record, has_values: bool) -> list[str]:
        """Return a name for each column, "" without one. Raises AmbiguousData for a name too few or too many."""
        names, used, line = record.fields, self._used, record.line
        if self._hints.header_row is None and len(names) == used - 1:
            if not self._is_counted and 0 in self._columns:
                raise ask(
                    self._path,
                    f"line {line} has {len(names)} names for {used} columns, and the first or the last has none",
                    Reading(f"--header-row {line}", f"the first column is {names[0]!r}, the last one has no name"),
                    NO_NAMES,
                )
            self._notes.append(f"line {line} has a name less than there are columns: the first one has none")
            return self._widen(["", *names])
        surplus = [name for name in names[used:] if name and not read_statement(line, name)]
        if surplus and self._hints.header_row is None and not has_values and len(names) != self._grid.width:
            raise ask(
                self._path,
                f"line {line} has {len(names)} names for {used} columns",
                Reading(f"--header-row {line}", f"the names hold from the left; {', '.join(surplus)} have no column"),
                NO_NAMES,
            )
        return self._widen(names)

    def _widen(self, fields: Sequence[str]) -> list[str]:
        return [*fields, *[""] * self._grid.width][: self._grid.width]

    def _is_word(self, field: str) -> bool:
        return parse_cell(field, self._grid.decimal) is None and not date_kind(field)

    def _are_names(self, record: Record, has_units_below: bool = False) -> bool:
        """Whether a record has texts for the columns that hold values, and as many fields as columns, or one less."""
        fields, used = record.fields, self._used
        is_short = len(fields) == used - 1
        if len(fields) < max(used - 1, 1) or (is_short and used == 2) or self._is_single_statement(record):
            return False
        if used == 1 and (len(fields) > 1 or re.search("[:=,;\t]", record.text)) and not unit_in_name(record.text):
            return False
        if self._grid.delimiter is None and len(fields) != used and not (is_short and self._is_counted):
            return False
        if has_units_below or self._are_numbered(record):
            return bool(fields[0]) and self._is_word(fields[0])
        texts = [fields[k] for k in self._columns if k < len(fields) and fields[k]]
        return len(texts) * 2 >= len([k for k in self._columns if k < len(fields)]) > 0 and all(
            map(self._is_word, texts)
        )

    def _are_numbered(self, record: Record) -> bool:
        """Whether a record is a text and then whole numbers, as channels are numbered: x-axis,1,2."""
        label, *rest = record.fields[: self._used] or [""]
        is_whole = all(re.fullmatch(r"\d{1,4}", field) for field in rest) and len({*rest}) == len(rest)
        return len(rest) == self._used - 1 > 0 and is_whole and bool(label) and self._is_word(label)

    def _is_single_statement(self, record: Record) -> bool:
        """Whether a record states one value under a key, as "Date,2024-03-04" and "# dt = 1e-4" do."""
        if self._grid.delimiter is None:
            pattern = r"\s*[^\s=,;\t][^=,;\t]{0,60}\s*=\s*\S" if "=" in record.text else r"[^:,;\t]{1,40}:\s+\S"
            return re.match(pattern, record.text) is not None and (
                "=" in record.text or len(record.fields) != self._used
            )
        fields = [field for field in record.fields if field]
        return len(fields) == 2 != self._used and re.search(r"\d", fields[1]) is not None

    def _is_misfit(self, record: Record) -> bool:
        """Whether a record looks like names, but for fewer columns."""
        fields = [field for field in record.fields if field]
        if len(fields) < 2 or self._grid.delimiter is None or self._is_single_statement(record):
            return False
        return len(record.fields) < self._used - 1 and all(map(self._is_word, fields))

    def _misfit(self, record: Record) -> AmbiguousData:
        return ask(
            self._path,
            f"line {record.line}, {_shown(record)!r}, has {len(record.fields)} names for {self._used} columns",
            Reading(f"--header-row {record.line}", "the names hold from the left; the other columns have none"),
            Reading(f"--skip-rows {record.line}", "the line is left out"),
        )

    def _are_units(self, record: Record) -> bool:
        """Whether most columns of numbers have a unit in a record, or at least half of the fields stand in brackets."""
        fields = [field for field in record.fields[: self._used] if field]
        bracketed = [field for field in fields if field[0] + field[-1] in ("[]", "()")]
        known = [field for field in fields if is_unit(_unit(field)) or is_counter_name(field) or field in ("-", "1")]
        covered = sum(k < len(record.fields) and bool(record.fields[k]) for k in self._columns)
        if covered * 2 <= len(self._columns) and self._used > 1:
            return False
        has_unit = bool(bracketed) or any(is_unit(_unit(field)) for field in fields)
        return has_unit and max(len(known), len(bracketed)) * 2 >= len(fields)

    def _clean(self, record: Record) -> Record:
        """Return a record without its comment sign and the empty fields at its end; blanks in names hold together."""
        visible = _INVISIBLE.sub(" ", record.text)
        text = visible[match.end() :] if (match := _COMMENT.match(visible)) else visible
        fields = self._grid.split(text)
        if self._grid.delimiter is None and len(fields) != self._used:
            parts = [[part for part in re.split(pattern, text.strip()) if part] for pattern in _FOLDED_BLANKS]
            fields = next((part for part in parts if len(part) == self._used), fields)
        fields = [field[1:-1] if field[:1] == field[-1:] == "'" else field for field in fields]
        while fields and not fields[-1]:
            fields = fields[:-1]
        return record._replace(fields=fields, text=text)

    def _statement(self, record: Record) -> Statement | None:
        """Return what a record above the table states, by its fields or by its text."""
        fields = record.fields
        if self._grid.delimiter is not None and len(fields) > 1 and fields[0] and not re.search("[=:].", fields[0]):
            return statement(record.line, fields[0], fields[1:])
        return read_statement(record.line, record.text)

    def _side_block(self) -> list[Statement]:
        """Return what a block of keys and values beside the numbers states, as Tektronix's scopes write it."""
        free = [k for k in range(self._grid.width) if k not in self._columns]
        if free[:2] != [0, 1]:
            return []
        entries = enumerate(self._rows, start=self._grid.first + 1)
        filled = [(line, row) for line, row in entries if len(row) == self._grid.width and row[0] and row[1]]
        return [statement(line, row[0], row[1 : min(self._columns)]) for line, row in filled]

    def _stated_names(self, statements: Sequence[Statement]) -> dict[int, tuple[str, str]]:
        """Return name and unit by column, as NAME0, NAME1 … or a scope's Source and its units state them."""
        numbers = self._grid.numbers
        numbered = numbered_names(statements)
        if numbered and len(numbered) == len(numbers):
            return {column: (numbered.get(k, ""), "") for k, column in enumerate(numbers)}
        if names := keyed_row(statements, NAME_KEYS, len(numbers)):
            return {column: (name, "") for column, name in zip(numbers, names, strict=True)}
        keys = {entry.key: entry.values[0] for entry in statements if entry.values}
        if "source" in keys and len(numbers) == 2:
            units = keys.get("horizontal units", ""), keys.get("vertical units", "")
            return {numbers[0]: ("Time", units[0]), numbers[1]: (keys["source"], units[1])}
        return {}


def ask_for_scale(path: Path, entry: Statement, name: str, value: float, lines: str) -> AmbiguousData:
    """Return the question whether a statement, in the `lines`, still changes the numbers of a column."""
    sign = "+" if "off" in entry.key or "zero" in entry.key else "*"
    return ask(
        path,
        f"line {entry.line} states {entry.text!r}: the numbers of {name!r} may be codes, or values already",
        Reading(f'--skip-rows {lines} --map "SIGNAL={split_unit(name)[0]} {sign} {value:g}"', "codes, converted by it"),
        Reading(f"--skip-rows {lines}", "values already; the line is left out"),
    )


def _has_text(record: Record) -> bool:
    return any(re.search(r"[^\W\d_]", field) for field in record.fields)


def _unit(field: str) -> str:
    return field.strip("[](){}<> ")


def _shown(record: Record) -> str:
    text = record.text.strip()
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"
