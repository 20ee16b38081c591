"""Layout of a table in text: delimiter, decimal sign, header, units, first and last row; found from its records.

Programs write any text at the beginning of a file: the records of numbers are searched, and the names above them. Lines
from the middle and the end are examined too: the first numbers of a German file may be 0, which shows no decimal sign.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from rtloop.interchange.formats.cells import NO_NUMBER, is_missing, is_value, parse_cell
from rtloop.interchange.formats.dates import date_kind
from rtloop.interchange.formats.table import Hints, Reading, UnreadableData, ask
from rtloop.interchange.formats.text_source import (
    SAMPLE_BYTES,
    Record,
    TextSource,
    logical_lines,
    split_fields,
    split_records,
)

SAMPLE_LINES = 1000
FOOTER_LINES = 20
DELIMITERS = {"tab": "\t", "\\t": "\t", "blank": None, "blanks": None, "space": None, " ": None, "comma": ",",
              "semicolon": ";", "pipe": "|"}  # fmt: skip
DECIMALS = {"point": ".", "comma": ",", ".": ".", ",": ","}
Notation = tuple[str | None, str]
_NOTATIONS: tuple[Notation, ...] = (
    (";", "."), ("\t", "."), (",", "."), ("|", "."), (";", ","), ("\t", ","), ("|", ","), (None, "."), (None, ","),
    (",", ","),
)  # fmt: skip
"""Delimiter (None: blanks) and decimal sign; the first of equally good ones is used."""


class Grid(NamedTuple):
    """The table's place in the text. `numbers` are its columns of numbers, from 0, `dates` those of dates by kind.

    `first`, from 0, is the line of the first row, `footer` are the lines behind the last. With `joined`, a comma both
    delimits and is the decimal sign: two fields make a number.
    """

    delimiter: str | None
    decimal: str
    joined: bool
    width: int
    numbers: tuple[int, ...]
    dates: dict[int, str]
    above: list[Record]
    first: int
    footer: list[str]

    def split(self, line: str) -> list[str]:
        """Return the fields of a line."""
        return _split(line, self.delimiter, self.joined)


def find_grid(source: TextSource, hints: Hints) -> Grid:
    """Return the place and the notation of the table in a text.

    Raises UnreadableData if no row of numbers is found in its first SAMPLE_BYTES; AmbiguousData where two notations
    read all rows.
    """
    lines = [*source.head, *source.later]
    skipped = [k for k in range(len(source.head)) if k + 1 in hints.skip_rows]
    lines = [line for line in logical_lines([s for k, s in enumerate(lines) if k not in skipped]) if line.strip()]
    lines = lines[:: -(-len(lines) // SAMPLE_LINES) or 1]
    delimiter, decimal, joined = _find_notation(source, lines, hints)
    rows = [_split(line, delimiter, joined) for line in lines]
    width = _width(rows)
    usual = [row for row in rows if len(row) == width]
    dates = _date_columns(usual)
    numbers = tuple(k for k in _number_columns(usual, decimal, hints.missing) if k not in dates)
    if not numbers:
        raise UnreadableData(
            f"{source.path}: contains no table; allowed: rows of numbers, separated by commas, semicolons, tabs, | or "
            "blanks"
        )
    grid = Grid(delimiter, decimal, joined, width, numbers, dates, [], 0, [])
    above: list[Record] = []
    for record in split_records(source.head, delimiter):
        if record.line in hints.skip_rows or not record.text.strip():
            continue
        is_header = hints.header_row is not None and record.line <= hints.header_row
        if not is_header and _is_row(grid, record.text, hints):
            footer = _footer(source, grid, hints)
            return grid._replace(above=above, first=record.line - 1, footer=footer)
        above.append(record)
    raise UnreadableData(
        f"{source.path}: no row of numbers in the first {SAMPLE_BYTES >> 10} KiB; shorten the text above the numbers, "
        "or leave lines out with --skip-rows"
    )


def _find_notation(source: TextSource, lines: Sequence[str], hints: Hints) -> tuple[str | None, str, bool]:
    """Return delimiter, decimal sign, and whether a comma is both without quotes."""
    notations = list(_NOTATIONS)
    if hints.delimiter is not None:
        delimiter = DELIMITERS.get(hints.delimiter, hints.delimiter)
        if delimiter is not None and len(delimiter) != 1:
            raise UnreadableData(f"{source.path}: --delimiter {delimiter!r}; allowed: one sign, tab or blank")
        notations = [(delimiter, "."), (delimiter, ",")]
    if hints.decimal is not None:
        if hints.decimal not in DECIMALS:
            raise UnreadableData(f"{source.path}: --decimal {hints.decimal!r}; allowed: . or ,")
        notations = [notation for notation in notations if notation[1] == DECIMALS[hints.decimal]]
    scores = [(_score(lines, *notation), -place) for place, notation in enumerate(notations)]
    score, place = max(scores)
    best = notations[-place]
    if score == 0:
        raise UnreadableData(
            f"{source.path}: contains no table; allowed: rows of numbers, separated by commas, semicolons, tabs, | or "
            "blanks"
        )
    if hints.decimal is None:
        other = (best[0], "," if best[1] == "." else ".")
        if other in notations and best[0] in (";", "\t", "|", None, ",") and scores[notations.index(other)][0] >= score:
            _require_one_decimal(source, lines, best, other)
    if best == (",", "."):
        return _comma_reading(source, lines, hints)
    joined = best == (",", ",") and hints.decimal is not None and not any('"' in line for line in lines[-20:])
    return best[0], best[1], joined


def _require_one_decimal(source: TextSource, lines: Sequence[str], best: Notation, other: Notation) -> None:
    """Raise AmbiguousData if some number has two values, as 1,234 has, and no number has one alone."""
    pairs = [
        (field, a.value, b.value)
        for line in lines
        for field in split_fields(line, best[0])
        if (a := parse_cell(field, best[1])) and (b := parse_cell(field, other[1]))
    ]
    different = [(field, a, b) for field, a, b in pairs if a != b and a == a]
    is_usual_point = best[1] == "." and all("." in field for field, _, _ in different) and best[0] != ";"
    if different and not is_usual_point:
        field, first, second = different[0]
        readings = [Reading(f"--decimal {best[1]}", f"{field} is {first:.12g}"),
                    Reading(f"--decimal {other[1]}", f"{field} is {second:.12g}")]  # fmt: skip
        raise ask(source.path, "the decimal sign has two readings", *readings)


def _comma_reading(source: TextSource, lines: Sequence[str], hints: Hints) -> tuple[str | None, str, bool]:
    """Return the notation of whole numbers between commas: fields, or one decimal comma in each number."""
    plain: tuple[str | None, str, bool] = (",", ".", False)
    rows = [split_fields(line, ",") for line in lines]
    width = _width(rows)
    usual = [row for row in rows if len(row) == width and any(parse_cell(field, ".") for field in row)]
    is_whole = all(re.fullmatch(r"[-+−]?\d+", a) and re.fullmatch(r"\d+([eE][-+]?\d+)?", b)
                   for row in usual for a, b in zip(row[::2], row[1::2], strict=False))  # fmt: skip
    if hints.delimiter or hints.decimal or width % 2 or not usual or not is_whole:
        return plain
    header = _header_text(lines)
    names = [] if header is None else [field for field in split_fields(header, ",") if field]
    if len(names) == width:
        return plain
    value = f"{usual[0][0]},{usual[0][1]}"
    if width == 2:
        if header is not None and len(names) == 1:
            return None, ",", False
        two = Reading("--delimiter ,", f"two columns: {value} is {usual[0][0]} and {usual[0][1]}")
        one = Reading("--decimal ,", f"one column: {value} is a number with a decimal comma")
        raise ask(source.path, "the comma has two readings", two, one)
    if len(names) == width // 2:
        many = Reading("--delimiter , --decimal .", f"{width} columns of whole numbers, for {len(names)} names")
        half = Reading("--delimiter , --decimal ,", f"{width // 2} columns: {value} is a number with a decimal comma")
        raise ask(source.path, "the comma has two readings", many, half)
    return plain


def _header_text(lines: Sequence[str]) -> str | None:
    """Return the last line of text above the first line of whole numbers; None without one."""
    header = None
    for line in lines:
        if re.fullmatch(r"[-+−\d,eE\s]+", line.strip()):
            return header
        header = line
    return header


def _split(line: str, delimiter: str | None, joined: bool) -> list[str]:
    fields = split_fields(line, delimiter)
    if joined and len(fields) % 2 == 0 and all(re.fullmatch(r"[-+−]?\d+([eE][-+]?\d+)?", field) for field in fields):
        return [f"{whole},{part}" for whole, part in zip(fields[::2], fields[1::2], strict=True)]
    return fields


def _score(lines: Sequence[str], delimiter: str | None, decimal: str) -> float:
    """Return the fraction of numbers among the fields of usual lines, times the fraction of usual lines.

    A usual line has the most frequent number of fields. Blank lines do not count; an empty field is no number.
    """
    rows = [split_fields(line, delimiter) for line in lines]
    width = _width(rows)
    regular_rows = [row for row in rows if len(row) == width]
    numbers = sum(bool(field) and is_value(field, decimal) for row in regular_rows for field in row)
    return numbers / max(width, 1) / max(len(rows), 1)


def _width(rows: Sequence[Sequence[str]]) -> int:
    """Return the most frequent number of fields of the nonempty rows; 0 without any."""
    counts = Counter(len(row) for row in rows if row)
    return counts.most_common(1)[0][0] if counts else 0


def _number_columns(rows: Sequence[Sequence[str]], decimal: str, missing: Sequence[str]) -> Iterator[int]:
    """Yield the columns in which most of the nonempty fields are numbers, or markers beside some number.

    A column that is mostly empty, with texts to its left in the same rows, has the values of a block of settings.
    """
    for column in range(len(rows[0]) if rows else 0):
        cells = [row[column] for row in rows]
        nonempty = [cell for cell in cells if cell]
        numbers = sum(parse_cell(cell, decimal) is not None for cell in nonempty)
        values = sum(is_value(cell, decimal, missing) for cell in nonempty)
        is_nan = sum(cell.lower() in NO_NUMBER for cell in nonempty) * 2 > len(nonempty)
        if not is_nan and (not numbers or values * 2 <= len(nonempty)):
            continue
        is_sparse = column > 0 and len(nonempty) * 2 < len(cells)
        labels = [row[column - 1] for row in rows if row[column]] if is_sparse else []
        if not (labels and all(label and not is_value(label, decimal) for label in labels)):
            yield column


def _date_columns(rows: Sequence[Sequence[str]]) -> dict[int, str]:
    """Return the kind of dates by column, for the columns in which most fields are dates of one kind."""
    dates = {}
    for column in range(len(rows[0]) if rows else 0):
        kinds = Counter(kind for row in rows if (kind := date_kind(row[column])))
        if kinds and kinds.most_common(1)[0][1] * 2 > len(rows):
            dates[column] = kinds.most_common(1)[0][0]
    return dates


def _is_row(grid: Grid, line: str, hints: Hints) -> bool:
    """Whether a line is a row: of the usual width, with a number or nothing in each column of numbers, and a number."""
    row = grid.split(line)
    if len(row) != grid.width:
        return False
    if any(not date_kind(row[k]) for k in grid.dates if row[k]):
        return False
    values = [row[k] for k in grid.numbers]
    is_filled = any(value and not is_missing(value, hints.missing) for value in values) or any(
        row[k] for k in grid.dates
    )
    return is_filled and all(is_value(value, grid.decimal, hints.missing) for value in values)


def _footer(source: TextSource, grid: Grid, hints: Hints) -> list[str]:
    """Return the last lines, up to FOOTER_LINES, that hold no number in any column of numbers."""
    footer: list[str] = []
    for line in reversed(logical_lines(source.tail)):
        row = grid.split(line)
        has_number = len(row) == grid.width and any(parse_cell(row[k], grid.decimal) for k in grid.numbers)
        is_short = 0 < len(row) < grid.width and all(is_value(cell, grid.decimal) for cell in row if cell) and any(row)
        has_date = len(row) == grid.width and any(date_kind(row[k]) for k in grid.dates)
        is_marked = len(row) == grid.width and any(row[k] and is_missing(row[k], hints.missing) for k in grid.numbers)
        if (
            has_number
            or is_short
            or has_date
            or is_marked
            or (len(row) > grid.width and parse_cell(row[0], grid.decimal))
        ):
            return footer[::-1]
        footer.append(line)
        if len(footer) > FOOTER_LINES:
            return []
    return []
