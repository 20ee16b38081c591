"""Dialect of a table in text: encoding, delimiter, decimal sign, header, units; found from its lines.

Programs write any text at the beginning of a file: the lines of numbers are searched, and the names above them. Lines
from the middle and the end are examined too: the first numbers of a German file may be 0, which shows no decimal sign.
"""

from __future__ import annotations

import csv
import os
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rtloop.foundation.trusted import open_user_file
from rtloop.interchange.formats.table import UnreadableData
from rtloop.interchange.units import is_unit

if TYPE_CHECKING:
    import pandas

SAMPLE_BYTES = 1 << 16
SAMPLE_LINES = 1000
LONGEST_LINE = 1 << 20
NO_NUMBER = ("", "nan", "-nan", "na", "n/a", "null", "none", "#n/a")
"""Texts in place of a missing number."""
INFINITE = ("inf", "-inf", "+inf", "infinity", "-infinity")
_POINT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_COMMA = re.compile(r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?")
_DATE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d([.,]\d+)?)?(Z|[-+]\d\d:?\d\d)?")
_NOTATIONS = (
    (";", "."),
    ("\t", "."),
    (",", "."),
    ("|", "."),
    (";", ","),
    ("\t", ","),
    ("|", ","),
    (None, "."),
    (None, ","),
)
"""Delimiter (None: blanks) and decimal sign; the first of equally good ones is used."""
_TRAILING_UNIT = re.compile(r"(?<=\d)\s+(s|sec|ms|min|hr|V|mV|nm|µm|um|mm)$")
"""Unit behind a number; MATLAB's timetables write durations so: 0.001 sec."""
_BYTE_ORDER_MARKS = ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))
_COMMENT = re.compile(r"\s*(#|%|//)+\s*")


class CsvDialect(NamedTuple):
    """Dialect of a table. `delimiter` is None for blanks; `first`, from 0, is the line of the first numbers.

    `numbers` and `dates` are the columns of numbers and dates, from 0; names and units are those of all columns.
    """

    encoding: str
    delimiter: str | None
    decimal: str
    first: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    numbers: tuple[int, ...]
    dates: tuple[int, ...]
    has_header: bool


def detect_dialect(path: Path) -> CsvDialect:
    """Return the dialect of a file, by a sample of its lines.

    Raises UnreadableData if the file is empty or no text, its first line is longer than SAMPLE_BYTES, or no row of
    numbers is found in its first SAMPLE_BYTES.
    """
    encoding, head, later_lines = _read_sample(path)
    lines = [*head, *later_lines]
    lines = lines[:: -(-len(lines) // SAMPLE_LINES)]
    scores = [(_score(lines, *notation), -place) for place, notation in enumerate(_NOTATIONS)]
    (score, place) = max(scores)
    delimiter, decimal = _NOTATIONS[-place]
    rows = [split_fields(line, delimiter) for line in lines]
    width = _width(rows)
    numbers = _number_columns([row for row in rows if len(row) == width], decimal)
    if score == 0 or not numbers:
        raise UnreadableData(
            f"{path}: contains no table; allowed: rows of numbers, separated by commas, semicolons, tabs, | or blanks"
        )
    first = _first_row((split_fields(line, delimiter) for line in head), width, numbers, decimal)
    if first is None:
        raise UnreadableData(
            f"{path}: no row of numbers in the first {SAMPLE_BYTES >> 10} KiB; shorten the text above the numbers"
        )
    names, units, has_header = _header(head[:first], delimiter, width)
    unit_matches = [_TRAILING_UNIT.search(field) for field in split_fields(head[first], delimiter)]
    units = tuple(match[1] if match else unit for match, unit in zip(unit_matches, units, strict=True))
    return CsvDialect(encoding, delimiter, decimal, first, names, units, numbers, _dates(rows, width), has_header)


def split_fields(line: str, delimiter: str | None) -> list[str]:
    """Return the fields of a line, without blanks and quotes around them; [] if it cannot be split.

    A `delimiter` of None is any number of blanks; quotes then stay.
    """
    if delimiter is None:
        return line.split()
    try:
        return [field.strip() for field in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]
    except csv.Error:
        return []


def is_number(field: str, decimal: str) -> bool:
    """Whether a field is a number, also infinite or with a unit behind it, or stands for a missing one ("", nan, …)."""
    field = _TRAILING_UNIT.sub("", field)
    return bool((_COMMA if decimal == "," else _POINT).fullmatch(field)) or field.lower() in (*NO_NUMBER, *INFINITE)


def strip_units(text: pandas.Series) -> pandas.Series:
    """Return a column of fields (a pandas series of text) without the units behind their numbers."""
    return text.str.replace(_TRAILING_UNIT, "", regex=True)


def _read_sample(path: Path) -> tuple[str, list[str], list[str]]:
    """Return encoding, the first lines, and some lines from the middle and the end.

    Raises UnreadableData if the file is empty, holds zero bytes, or has a first line longer than the sample.
    """
    size = path.stat().st_size
    with os.fdopen(open_user_file(path), "rb") as file:
        blocks = [file.read(SAMPLE_BYTES)]
        for place in (size // 2, size - SAMPLE_BYTES):
            if place > SAMPLE_BYTES:
                file.seek(place // 4 * 4)
                blocks.append(file.read(SAMPLE_BYTES))
    encoding = next((name for mark, name in _BYTE_ORDER_MARKS if blocks[0].startswith(mark)), None) or _encoding(
        blocks[0]
    )
    plain = "utf-16-le" if blocks[0].startswith(b"\xff\xfe") else "utf-16-be" if encoding == "utf-16" else encoding
    texts = [block.decode(encoding if k == 0 else plain, "replace") for k, block in enumerate(blocks)]
    if any("\0" in text for text in texts):
        raise UnreadableData(
            f"{path}: neither text nor another known kind of file: MAT, HDF5, npz, Parquet, MCAP or Stabilizer's stream"
        )
    is_complete = len(blocks[0]) == size
    head = texts[0].splitlines()[: None if is_complete else -1]
    if not head:
        fault = f"the first line is longer than {SAMPLE_BYTES} bytes" if size else "empty"
        raise UnreadableData(f"{path}: {fault}; allowed: a text file with lines of numbers")
    return encoding, head, [line for text in texts[1:] for line in text.splitlines()[1:-1]]


def _encoding(block: bytes) -> str:
    """Return the encoding of text without a byte order mark: "utf-8", or "cp1252" if it is not UTF-8."""
    try:
        block[: -4 if len(block) == SAMPLE_BYTES else None].decode()
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def _score(lines: Sequence[str], delimiter: str | None, decimal: str) -> float:
    """Return the fraction of numbers among the fields of usual lines, times the fraction of usual lines.

    A usual line has the most frequent number of fields. Blank lines do not count; an empty field is no number.
    """
    rows = [split_fields(line, delimiter) for line in lines if line.strip()]
    width = _width(rows)
    regular_rows = [row for row in rows if len(row) == width]
    numbers = sum(bool(field) and is_number(field, decimal) for row in regular_rows for field in row)
    return numbers / max(width, 1) / max(len(rows), 1)


def _width(rows: Sequence[Sequence[str]]) -> int:
    """Return the most frequent number of fields of the nonempty rows; 0 without any."""
    counts = Counter(len(row) for row in rows if row)
    return counts.most_common(1)[0][0] if counts else 0


def _number_columns(rows: Sequence[Sequence[str]], decimal: str) -> tuple[int, ...]:
    """Return the indices of the columns in which most of the nonempty fields are numbers."""
    width = len(rows[0]) if rows else 0
    return tuple(
        column
        for column in range(width)
        if any(row[column] for row in rows)
        and sum(bool(row[column]) and is_number(row[column], decimal) for row in rows) * 2
        > sum(bool(row[column]) for row in rows)
    )


def _dates(rows: Sequence[Sequence[str]], width: int) -> tuple[int, ...]:
    """Return the indices of the columns in which most fields are dates with times, such as 2024-03-01 12:00:00.25."""
    usual = [row for row in rows if len(row) == width]
    return tuple(k for k in range(width) if sum(bool(_DATE.fullmatch(row[k])) for row in usual) * 2 > len(usual))


def _first_row(rows: Iterable[Sequence[str]], width: int, numbers: Sequence[int], decimal: str) -> int | None:
    """Return the index of the first row of `width` fields with numbers in all columns `numbers`; None without one.

    Some of these columns may be empty in the row, but not all of them.
    """
    for number, row in enumerate(rows):
        is_data_row = len(row) == width and all(is_number(row[column], decimal) for column in numbers)
        if is_data_row and any(row[column] for column in numbers):
            return number
    return None


def _header(lines: Sequence[str], delimiter: str | None, width: int) -> tuple[tuple[str, ...], tuple[str, ...], bool]:
    """Return names and units of all `width` columns by the lines above the numbers, and whether there are names.

    The names are from the last of these lines with `width` or `width` − 1 fields, or from the one before if the last
    has units, as `_are_units` finds. A column without a name is `column_1`, …; one without a unit has "".
    """
    header_rows = [split_fields(_COMMENT.sub("", line, count=1), delimiter) for line in lines]
    candidates = [
        [*row, *[""] * (width - len(row))] for row in header_rows if width - 1 <= len(row) <= width and any(row)
    ]
    units = [""] * width
    if len(candidates) > 1 and _are_units(candidates[-1]):
        units = [field.strip("[]() ") for field in candidates.pop()]
    if not candidates:
        return tuple(f"column_{number}" for number in range(1, width + 1)), tuple(units), False
    names = [name or f"column_{number}" for number, name in enumerate(candidates[-1], start=1)]
    return tuple(names), tuple(units), True


def _are_units(fields: Sequence[str]) -> bool:
    """Whether at least half of the nonempty `fields` of a row are units, or at least half stand in brackets."""
    nonempty_fields = [field for field in fields if field]
    bracketed_count = sum(field[0] + field[-1] in ("[]", "()") for field in nonempty_fields)
    return bool(nonempty_fields) and max(
        sum(is_unit(field.strip("[]()")) for field in nonempty_fields), bracketed_count
    ) * 2 >= len(nonempty_fields)
