"""Tables in text: CSV and similar files, with any delimiter, decimal sign, header and units."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.errors import MissingExtra
from rtloop.foundation.arrays import Real
from rtloop.interchange.formats.cells import NO_MARKER, NO_NUMBER, is_missing, parse_cell
from rtloop.interchange.formats.clock_groups import split_clocks
from rtloop.interchange.formats.dates import dates_ns, has_one_order, unroll_days
from rtloop.interchange.formats.dialect import Grid, find_grid
from rtloop.interchange.formats.groups import MAX_BYTES, MAX_COLUMNS, are_codes, exact_floats, select_table, unique_name
from rtloop.interchange.formats.header import Header, HeaderReader, ask_for_scale
from rtloop.interchange.formats.stated import scale_statements, stated_rates, stated_ticks
from rtloop.interchange.formats.table import MAX_ROWS, NO_HINTS, Hints, Reading, Table, UnreadableData, ask
from rtloop.interchange.formats.text_source import LineStream, TextSource
from rtloop.interchange.names import is_counter_name, split_unit
from rtloop.interchange.units import UnknownUnit, factor_between
from rtloop.values import count_text

ROWS_AT_ONCE = 1 << 16
BESIDE_ROWS = 30
"""Rows in which settings may stand beside the numbers."""


def read_csv(path: Path, hints: Hints = NO_HINTS) -> Table:
    """Return the columns of numbers and dates; columns of text are left out.

    Dates become s since the first row; the first column of dates becomes the table's column of times. Columns of times
    with their columns behind them are groups. Raises AmbiguousData where two readings remain; UnreadableData for a file
    without a table, with damaged or uneven rows, with a text among the numbers or a missing date, and beyond
    MAX_COLUMNS, MAX_ROWS or MAX_BYTES; MissingExtra without pandas.
    """
    with closing(TextSource(path)) as source:
        return _read(source, hints)


def _read(source: TextSource, hints: Hints) -> Table:
    path, grid = source.path, find_grid(source, hints)
    if grid.width > MAX_COLUMNS:
        raise UnreadableData(f"{path}: {grid.width} columns; allowed: up to {MAX_COLUMNS}")
    beside = [grid.split(line) for line in source.head[grid.first : grid.first + BESIDE_ROWS]]
    header = HeaderReader(path, grid, beside, hints).read()
    reader = _Reader(source, grid, header, hints)
    reader.read()
    return _make_table(reader)


class _Reader:
    """Reads the rows block by block, and accounts for what is no plain number."""

    def __init__(self, source: TextSource, grid: Grid, header: Header, hints: Hints) -> None:
        self.source, self.grid, self.header, self.hints = source, grid, header, hints
        self.columns = (*grid.dates, *grid.numbers)
        self.blocks: list[list[npt.NDArray[Any]]] = []
        self.units: dict[int, str] = {}
        """Units behind the numbers themselves, by column."""
        self.markers: dict[int, Counter[str]] = {}
        self.plain: set[int] = set()
        """Columns with a block of numbers without units."""
        self.filled: set[int] = set()
        """Columns with any value or text."""
        self.long: dict[int, int] = {}
        """Columns of numbers with more digits than a float64 has, and the whole number taken from each."""
        self._texts = [*hints.missing, *NO_NUMBER]
        if NO_MARKER in hints.missing:
            self._texts = ["", *(text for text in hints.missing if text != NO_MARKER)]

        for column in grid.numbers:
            cells = [row[column] for row in self._sample if len(row) == grid.width]
            if cells and all(re.fullmatch(rf"\d{{8,18}}{re.escape(grid.decimal)}\d+", cell) for cell in cells):
                self.long[column] = int(re.split("[.,]", cells[0])[0])

    @property
    def _sample(self) -> list[list[str]]:
        """Return some of the first rows."""
        return [self.grid.split(line) for line in self.source.head[self.grid.first :][:BESIDE_ROWS] if line.strip()]

    @property
    def path(self) -> Path:
        return self.source.path

    def lines(self) -> LineStream:
        """Return the lines from the first row to the last one."""
        lines = self.source.lines(self.grid.first, self.grid.footer, self.hints.skip_rows)
        if self.grid.joined:
            lines.join = lambda line: re.sub(r"([-+−]?\d+),(\d+(?:[eE][-+]?\d+)?)", r"\1.\2", line)
        elif self.grid.delimiter is None:
            lines.join = str.strip if not any(map(str.strip, self.source.head)) else None
        return lines

    def read(self) -> None:
        """Read all rows into `blocks`, each a list of columns: first the dates, in ns, then the numbers.

        Raises UnreadableData, with the place, for a text among the numbers, a missing date and a row with too many or
        too few fields; also for too many rows. Raises MissingExtra without pandas.
        """
        try:
            import pandas
        except ImportError:
            raise MissingExtra("CSV needs pandas: pip install 'rtloop[data]'") from None
        grid, rows, max_rows = self.grid, 0, min(MAX_ROWS, MAX_BYTES // (8 * len(self.columns)))
        without_last: list[npt.NDArray[np.intp]] = []
        lines = self.lines()
        try:
            with pandas.read_csv(
                lines,
                sep=r"\s+" if grid.delimiter is None else grid.delimiter,
                decimal="." if grid.joined else grid.decimal,
                header=None,
                names=range(grid.width),
                na_values=self._texts,
                keep_default_na=NO_MARKER not in self.hints.missing,
                skipinitialspace=True,
                low_memory=False,
                dtype=dict.fromkeys(self.long, str),
                chunksize=ROWS_AT_ONCE,
            ) as reader:
                for block in reader:
                    lacks_last = block.iloc[:, -1].isna().to_numpy()
                    # where all rows lack it, the column is empty, or all are as short as the first one
                    without_last.append(rows + np.flatnonzero(lacks_last)[: 1 if lacks_last.all() else None])
                    self.filled |= {column for column in range(grid.width) if block[column].notna().any()}
                    dates = [self._dates(block[column]) for column in grid.dates]
                    self.blocks.append([*dates, *(self._numbers(block[column]) for column in grid.numbers)])
                    rows += len(block)
                    if rows > max_rows:
                        raise UnreadableData(
                            f"{self.path}: more than {max_rows} rows of {len(grid.numbers)} numbers; split the file, "
                            "or leave out columns when you write the file"
                        )
        except (pandas.errors.ParserError, pandas.errors.EmptyDataError, UnicodeError) as fault:
            raise UnreadableData(f"{self.path}: {self._parser_message(str(fault))}") from None
        finally:
            lines.close()
        self._require_even_rows(np.concatenate(without_last))

    def _require_even_rows(self, without_last: npt.NDArray[np.intp]) -> None:
        """Raise UnreadableData for the first row with fewer columns than the others, unless it is the last of the file.

        `without_last` has the rising indices of the rows to examine, which have no value in their last column; the
        first row of numbers has index 0. The last row of a file may be cut off.
        """
        checked_count, short_row = 0, None
        for row, (number, line) in enumerate(self._number_rows()):
            if short_row is not None:
                raise UnreadableData(f"{self.path}: {self._uneven_row_message(*short_row)}")
            if checked_count == without_last.size:
                return
            if row == without_last[checked_count]:
                checked_count += 1
                fields = self.grid.split(line)
                short_row = (number, len(fields)) if 0 < len(fields) < self.grid.width else None

    def _number_rows(self) -> Iterator[tuple[int, str]]:
        """Yield, for each line with a row of numbers, its line number in the file, from 1, and its text.

        Empty lines and lines of blanks and tabs are left out, as pandas does.
        """
        delimiter = self.grid.delimiter
        for number, line in self.lines().numbered():
            if line.strip(" \t\r\n") or (delimiter is not None and delimiter in line):
                yield number, line

    def line_number(self, row: int) -> int:
        """Return the line number in the file, from 1, of the row of numbers with index `row`, from 0.

        The result is too small if an earlier row has a quoted text with line breaks.
        """
        number, _ = next(itertools.islice(self._number_rows(), row, None), (self.grid.first + row + 1, ""))
        return number

    def _uneven_row_message(self, line: int, columns: int) -> str:
        """Return the message for a line, counted from 1, with another number of columns than most lines."""
        return (
            f"line {line} has {count_text(columns, 'column')}; allowed: {self.grid.width}, as in most lines. Leave it "
            f"out with --skip-rows {line}, or correct it"
        )

    def _parser_message(self, fault: str) -> str:
        """Return pandas's message with the file's line numbers; pandas counts from the first numbers on."""
        words = fault.removeprefix("Error tokenizing data. C error: ").strip()
        if match := re.fullmatch(r"Expected (\d+) fields in line (\d+), saw (\d+)", words):
            return self._uneven_row_message(int(match[2]) + self.grid.first, int(match[3]))
        return "damaged: " + re.sub(r"line (\d+)", lambda match: f"line {int(match[1]) + self.grid.first}", words)

    def _numbers(self, values: Any) -> npt.NDArray[Any]:
        """Return the numbers of a column, a series of pandas, as float64 or whole numbers; missing ones are NaN.

        Raises AmbiguousData at the first text.
        """
        import pandas

        if values.name in self.long:
            parts = values.str.strip().str.extract(r"^(\d+)[.,]?(\d*)$")
            if parts.notna().all(axis=None):
                whole = parts[0].astype(np.int64).to_numpy() - self.long[values.name]
                return whole + ("0." + parts[1] + "0").astype(np.float64).to_numpy()
            self.long.pop(values.name)
        if values.dtype.kind in "iufb":
            self.plain.add(values.name)
            if self._lacks_unit(values.name):
                raise self._unit_for_some(values.name, int(values.index[0]))
            return values.to_numpy() if values.dtype.kind in "iu" else values.to_numpy(np.float64)
        text = values.astype(str).str.strip()
        plain = text.str.replace(",", ".", regex=False) if self.grid.decimal == "," and not self.grid.joined else text
        if self.grid.decimal == ",":
            plain = plain.where(~text.str.contains(".", regex=False), "")
        numbers = np.array(pandas.to_numeric(plain, errors="coerce"), np.float64)
        odd = np.isnan(numbers) & ~values.isna().to_numpy()
        if odd.any():
            self._odd_cells(values, text, numbers, odd)
        return numbers

    def _odd_cells(self, values: Any, text: Any, numbers: Real, odd: npt.NDArray[np.bool_]) -> None:
        """Read the cells `odd`, which are no plain numbers, into `numbers`."""
        column = values.name
        target = self.units.get(column) or self.header.units[column] or split_unit(self.header.names[column])[1] or ""
        counts = self.markers.setdefault(column, Counter())
        has_units = False
        for row in np.flatnonzero(odd):
            cell = text.iloc[row]
            parsed = parse_cell(cell, self.grid.decimal)
            if parsed is None and is_missing(cell, self.hints.missing):
                if cell.lower() not in NO_NUMBER:
                    counts[cell] += 1
            elif parsed is None:
                raise self._no_number(column, cell, int(values.index[row]))
            else:
                target = target or parsed.unit
                numbers[row] = parsed.value * self._factor(column, parsed.unit, target, int(values.index[row]))
                has_units |= bool(parsed.unit)
        if has_units:
            self.units[column] = target
        is_plain = ~odd & np.isfinite(numbers)
        if self._lacks_unit(column) and (is_plain.any() or column in self.plain):
            row = int(values.index[int(np.argmax(is_plain if is_plain.any() else odd))])
            raise self._unit_for_some(column, row)

    def _lacks_unit(self, column: int) -> bool:
        """Whether a column with units behind its numbers has none in its header."""
        stated = self.header.units[column] or split_unit(self.header.names[column])[1]
        return column in self.units and not stated

    def _unit_for_some(self, column: int, row: int) -> UnreadableData:
        return UnreadableData(
            f"{self.path}: column {self.header.names[column]!r}: some values have a unit behind them, others have none "
            f"(about line {self.line_number(row)}); write the unit into the column's name"
        )

    def _factor(self, column: int, unit: str, target: str, row: int) -> float:
        if unit in ("", target):
            return 1.0
        try:
            return float(factor_between(unit, target))
        except UnknownUnit:
            raise UnreadableData(
                f"{self.path}: column {self.header.names[column]!r}: a value in {unit} beside values in {target} "
                f"(about line {self.line_number(row)}); split the file by unit"
            ) from None

    def _no_number(self, column: int, cell: str, row: int) -> UnreadableData:
        line, cell = self.line_number(row), cell[:60]
        return ask(
            self.path,
            f"column {self.header.names[column]!r}: {cell!r} is not a number (about line {line})",
            Reading(f"--missing {cell!r}", "the cell, and each like it, is a missing value"),
            Reading(f"--skip-rows {line}", f"line {line} is left out"),
        )

    def _dates(self, values: Any) -> npt.NDArray[np.int64]:
        """Return the dates of a column, a series of pandas, in ns. Raises UnreadableData at a field without one."""
        column = values.name
        text, kind = values.astype(str).str.strip(), self.grid.dates[column]
        if kind == "slashes" and self.hints.dates is None and not has_one_order(text):
            date = text.iloc[0]
            raise ask(
                self.path,
                f"column {self.header.names[column]!r}: {date!r} begins with the day or with the month",
                Reading("--dates day", "the day"),
                Reading("--dates month", "the month"),
            )
        ns = dates_ns(text, kind, self.hints.dates)
        is_bad = ns == np.iinfo(np.int64).min
        if is_bad.any():
            line = self.line_number(int(values.index[int(np.argmax(is_bad))]))
            raise UnreadableData(f"{self.path}: column {self.header.names[column]!r}: no date (about line {line})")
        return ns


def _make_table(reader: _Reader) -> Table:
    """Return the table, or the selected group, of what was read."""
    grid, header, hints = reader.grid, reader.header, reader.hints
    notes, columns, units, origins = [*header.notes], dict[str, Real](), dict[str, str](), dict[str, int]()
    names: dict[int, str] = {}
    for k, column in enumerate(reader.columns):
        name = names[column] = unique_name(header.names[column], names.values())
        values: npt.NDArray[Any] = np.concatenate([block[k] for block in reader.blocks])
        if column in grid.dates:
            values = unroll_days(values) if grid.dates[column] in ("time of day", "minutes") else values
            columns[name], units[name] = np.asarray(values - values[:1], np.float64) * 1e-9, "s"
            continue
        columns[name], origin = exact_floats(values)
        origin += reader.long.get(column, 0)
        if origin:
            origins[name] = origin
        if unit := reader.units.get(column) or header.units[column]:
            units[name] = unit
    for column, counts in reader.markers.items():
        listed = ", ".join(f"{count} × {marker!r}" for marker, count in counts.most_common(5))
        if counts:
            notes.append(f"{names[column]}: {count_text(counts.total(), 'value')} missing: {listed}")
    if footer := [line.strip() for line in grid.footer if line.strip(f" \t\r\n{grid.delimiter or ''}")]:
        notes.append(f"{count_text(len(footer), 'line')} below the numbers left out: {'; '.join(footer)[:100]!r}")
    columns = _without_empty_end(reader, columns, notes)
    if hints.skip_rows:
        notes.append(f"lines left out by --skip-rows: {', '.join(map(str, hints.skip_rows))}")
    table = Table(
        columns,
        units,
        names[next(iter(grid.dates))] if grid.dates else None,
        _describe(reader, names),
        rates=tuple((rate.hz, rate.source) for rate in stated_rates(header.statements, grid.decimal)),
        tick_hz=stated_ticks(header.statements, grid.decimal),
        unnamed=tuple(name for name in header.unnamed if name in columns),
        origins=origins,
        notes=tuple(notes),
    )
    _require_no_codes(reader, columns)
    groups = split_clocks(table)
    if len(groups) == 1:
        return next(iter(groups.values()))
    return select_table(reader.path, groups, hints.group or _group_of(groups, hints.clock))


def _require_no_codes(reader: _Reader, columns: dict[str, Real]) -> None:
    """Raise AmbiguousData for whole numbers below a line that states a factor: they may be a converter's codes."""
    entries = [
        e for e in scale_statements(reader.header.statements, reader.grid.decimal) if e.line <= reader.grid.first
    ]
    name = next((name for name, values in columns.items() if are_codes(values) and not is_counter_name(name)), None)
    if not entries or name is None:
        return
    entry, skip = entries[0], ",".join(str(e.line) for e in entries)
    factor = entry.numbers(reader.grid.decimal)[0][0]
    raise ask_for_scale(reader.path, entry, name, factor, skip)


def _group_of(groups: dict[str, Table], clock: str | None) -> str | None:
    return clock if clock in groups else None


def _without_empty_end(reader: _Reader, columns: dict[str, Real], notes: list[str]) -> dict[str, Real]:
    """Return the columns without the last rows that have no value at all; a note counts them."""
    has_value = np.any([np.isfinite(values) | np.isinf(values) for values in columns.values()], axis=0)
    end = len(has_value) - int(np.argmax(has_value[::-1])) if has_value.any() else 0
    blanks = f" \t\r\n{reader.grid.delimiter or ''}"
    removed = len(has_value) - end + sum(bool(line.strip()) and not line.strip(blanks) for line in reader.grid.footer)
    if removed:
        notes.append(f"{count_text(removed, 'row')} without a value at the end left out")
    return {name: values[:end] for name, values in columns.items()} if end < len(has_value) else columns


def _describe(reader: _Reader, names: dict[int, str]) -> dict[str, str]:
    """Return what was understood of the text, by subject."""
    grid, header = reader.grid, reader.header
    delimiter = {None: "blanks", "\t": "tabs"}.get(grid.delimiter, repr(grid.delimiter))
    about = {
        "table": f"columns separated by {delimiter}, decimal sign {grid.decimal!r}, {reader.source.encoding}, "
        f"numbers from line {grid.first + 1} on" + ("" if len(header.unnamed) < grid.width else ", no column names")
    }
    text = [
        name
        for k, name in enumerate(header.names)
        if k not in names and k in reader.filled and name not in header.unnamed
    ]
    if text:
        about["left out"] = ", ".join(f"{name} (text)" for name in text)
    return about
