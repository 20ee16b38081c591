"""Tables in text: CSV and similar files, with any delimiter, decimal sign, header and units."""

from __future__ import annotations

import contextlib
import csv
import io
import itertools
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.errors import MissingExtra
from rtloop.foundation.arrays import Real
from rtloop.foundation.trusted import open_user_file
from rtloop.interchange.formats.dialect import LONGEST_LINE, NO_NUMBER, CsvDialect, detect_dialect, strip_units
from rtloop.interchange.formats.groups import MAX_BYTES, MAX_COLUMNS, unique_name
from rtloop.interchange.formats.table import MAX_ROWS, Table, UnreadableData
from rtloop.values import count_text

ROWS_AT_ONCE = 1 << 16
DELIMITER_NAMES = {None: "blanks", "\t": "tabs"}


def read_csv(path: Path) -> Table:
    """Return the columns of numbers and dates; columns of text are left out.

    Dates become s since the first row; the first column of dates becomes the table's column of times. Raises
    UnreadableData for a file without a table, with damaged or uneven rows, with a text among the numbers or a missing
    date, and beyond MAX_COLUMNS, MAX_ROWS or MAX_BYTES; MissingExtra without pandas.
    """
    dialect = detect_dialect(path)
    if len(dialect.names) > MAX_COLUMNS:
        raise UnreadableData(f"{path}: {len(dialect.names)} columns; allowed: up to {MAX_COLUMNS}")
    blocks = _read_numbers(path, dialect)
    names: list[str] = []
    used_columns = (*dialect.dates, *dialect.numbers)
    for column in used_columns:
        names.append(unique_name(dialect.names[column], names))
    columns = {name: np.concatenate([block[k] for block in blocks]) for k, name in enumerate(names)}
    units = {name: dialect.units[column] for name, column in zip(names, used_columns, strict=True)}
    for name in names[: len(dialect.dates)]:
        columns[name], units[name] = (columns[name] - columns[name][:1]) * 1e-9, "s"
    delimiter_name = DELIMITER_NAMES.get(dialect.delimiter, repr(dialect.delimiter))
    about = {
        "table": f"columns separated by {delimiter_name}, decimal sign {dialect.decimal!r}, "
        f"{dialect.encoding.removesuffix('-sig')}, numbers from line {dialect.first + 1} on"
        + ("" if dialect.has_header else ", no column names")
    }
    text = [name for k, name in enumerate(dialect.names) if k not in used_columns and not name.startswith("column_")]
    if text:
        about["left out"] = ", ".join(f"{name} (text)" for name in text)
    return Table(
        columns, {name: unit for name, unit in units.items() if unit}, names[0] if dialect.dates else None, about
    )


class _NumberLines(io.TextIOBase):
    """Text of a file from the line of its first numbers on; `read` raises UnreadableData for bytes that are no text."""

    def __init__(self, path: Path, dialect: CsvDialect) -> None:
        """Open the file and skip the lines above its numbers. Raises OSError if it cannot be opened."""
        self._path, self._line_length = path, 0
        self._file = os.fdopen(open_user_file(path), encoding=dialect.encoding, errors="replace", newline=None)
        for _ in range(dialect.first):
            self._file.readline()

    def readable(self) -> bool:
        """Return True, as pandas requires."""
        return True

    def read(self, size: int | None = -1) -> str:
        """Return up to `size` characters. Raises UnreadableData for zero bytes and a line longer than LONGEST_LINE."""
        text = self._file.read(size)
        self._line_length = len(text) - text.rfind("\n") - 1 if "\n" in text else self._line_length + len(text)
        if "\0" in text or self._line_length > LONGEST_LINE:
            fault = "zero bytes, which are not text" if "\0" in text else f"a line longer than {LONGEST_LINE >> 20} MiB"
            raise UnreadableData(f"{self._path}: damaged: contains {fault}")
        return text

    def __iter__(self) -> Iterator[str]:
        """Return an iterator over the lines, with their ends; it checks nothing, unlike `read`."""
        return iter(self._file)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _read_numbers(path: Path, dialect: CsvDialect) -> list[list[npt.NDArray[Any]]]:
    """Return blocks of rows, each a list of columns (rows,): first the dates, in ns since 1970, then the numbers.

    Raises UnreadableData, with the place, for a text among the numbers, a missing date and a row with too many or too
    few fields; also for too many rows. Raises MissingExtra without pandas.
    """
    try:
        import pandas
    except ImportError:
        raise MissingExtra("CSV needs pandas: pip install 'rtloop[data]'") from None
    blocks: list[list[npt.NDArray[Any]]] = []
    without_last: list[npt.NDArray[np.intp]] = []
    rows, max_rows = 0, min(MAX_ROWS, MAX_BYTES // (8 * len(dialect.numbers)))
    lines = _NumberLines(path, dialect)
    try:
        with pandas.read_csv(
            lines,
            sep=r"\s+" if dialect.delimiter is None else dialect.delimiter,
            decimal=dialect.decimal,
            header=None,
            names=range(len(dialect.names)),
            na_values=list(NO_NUMBER),
            skipinitialspace=True,
            low_memory=False,
            chunksize=ROWS_AT_ONCE,
        ) as reader:
            for block in reader:
                dates = [_dates_ns(path, dialect, block[column]) for column in dialect.dates]
                lacks_last = block.iloc[:, -1].isna().to_numpy()
                # where all rows lack it, the column is empty, or all are as short as the first one
                without_last.append(rows + np.flatnonzero(lacks_last)[: 1 if lacks_last.all() else None])
                blocks.append([*dates, *(_column_numbers(path, dialect, block[column]) for column in dialect.numbers)])
                rows += len(block)
                if rows > max_rows:
                    raise UnreadableData(
                        f"{path}: more than {max_rows} rows of {len(dialect.numbers)} numbers; split the file, or "
                        "leave out columns when you write the file"
                    )
    except (pandas.errors.ParserError, pandas.errors.EmptyDataError, UnicodeError) as fault:
        raise UnreadableData(f"{path}: {_parser_message(str(fault), dialect)}") from None
    finally:
        lines.close()
    _require_even_rows(path, dialect, np.concatenate(without_last))
    return blocks


def _require_even_rows(path: Path, dialect: CsvDialect, without_last: npt.NDArray[np.intp]) -> None:
    """Raise UnreadableData for the first row with fewer columns than the others, unless it is the last of the file.

    `without_last` has the rising indices of the rows to examine, which have no value in their last column; the first
    row of numbers has index 0. The last row of a file may be cut off.
    """
    checked_count, short_row = 0, None
    with contextlib.closing(_NumberLines(path, dialect)) as lines:
        for row, (number, line) in enumerate(_number_rows(lines, dialect)):
            if short_row is not None:
                raise UnreadableData(f"{path}: {_uneven_row_message(*short_row, dialect)}")
            if checked_count == without_last.size:
                return
            if row == without_last[checked_count]:
                checked_count += 1
                delimiter = dialect.delimiter
                fields = line.split() if delimiter is None else next(csv.reader([line], delimiter=delimiter), [])
                short_row = (number, len(fields)) if 0 < len(fields) < len(dialect.names) else None


def _number_rows(lines: _NumberLines, dialect: CsvDialect) -> Iterator[tuple[int, str]]:
    """Yield, for each line with a row of numbers, its line number in the file, from 1, and its text.

    Empty lines and lines of blanks and tabs are left out, as pandas does.
    """
    for number, line in enumerate(lines, start=dialect.first + 1):
        if line.strip(" \t\r\n") or (dialect.delimiter is not None and dialect.delimiter in line):
            yield number, line


def _line_number(path: Path, dialect: CsvDialect, row: int) -> int:
    """Return the line number in the file, from 1, of the row of numbers with index `row`, from 0.

    The result is too small if an earlier row has a quoted text with line breaks.
    """
    with contextlib.closing(_NumberLines(path, dialect)) as lines:
        number, _ = next(itertools.islice(_number_rows(lines, dialect), row, None), (dialect.first + row + 1, ""))
        return number


def _uneven_row_message(line: int, columns: int, dialect: CsvDialect) -> str:
    """Return the message for a line, counted from 1, with another number of columns than most lines."""
    allowed = f"allowed: {len(dialect.names)}, as in most lines"
    return f"line {line} has {count_text(columns, 'column')}; {allowed}"


def _column_numbers(path: Path, dialect: CsvDialect, values: Any) -> Real:
    """Return the numbers of a column, a series of pandas, as float64; missing ones are NaN.

    Raises UnreadableData at the first text.
    """
    import pandas

    if values.dtype.kind in "fiub":
        return values.to_numpy(np.float64)
    text = strip_units(values.astype(str).str.strip())
    if dialect.decimal == ",":
        text = text.str.replace(",", ".")
    numbers = np.asarray(pandas.to_numeric(text, errors="coerce"), np.float64)
    invalid_rows = np.flatnonzero(np.isnan(numbers) & ~text.str.lower().isin(NO_NUMBER).to_numpy())
    if invalid_rows.size:
        row = int(values.index[invalid_rows[0]])
        raise UnreadableData(
            f"{path}: column {dialect.names[values.name]!r}: {str(values.iloc[invalid_rows[0]])[:60]!r} is not a "
            f"number (about line {_line_number(path, dialect, row)})"
        )
    return numbers


def _dates_ns(path: Path, dialect: CsvDialect, values: Any) -> npt.NDArray[np.int64]:
    """Return the dates of a column, a series of pandas, as ns since 1970 in UTC, int64.

    A date without a time zone counts as UTC. Raises UnreadableData at the first field without a date, such as NaN.
    """
    import pandas

    dates = pandas.to_datetime(values.astype(str).str.replace(",", "."), format="ISO8601", utc=True, errors="coerce")
    if dates.isna().any():
        row = int(values.index[int(np.argmax(dates.isna()))])
        line = _line_number(path, dialect, row)
        raise UnreadableData(f"{path}: column {dialect.names[values.name]!r}: no date (about line {line})")
    return dates.dt.tz_localize(None).to_numpy("datetime64[ns]").astype(np.int64)


def _parser_message(fault: str, dialect: CsvDialect) -> str:
    """Return pandas's message with the file's line numbers; pandas counts from the first numbers on."""
    words = fault.removeprefix("Error tokenizing data. C error: ").strip()
    if match := re.fullmatch(r"Expected (\d+) fields in line (\d+), saw (\d+)", words):
        return _uneven_row_message(int(match[2]) + dialect.first, int(match[3]), dialect)
    return "damaged: " + re.sub(r"line (\d+)", lambda match: f"line {int(match[1]) + dialect.first}", words)
