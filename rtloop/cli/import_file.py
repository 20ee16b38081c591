"""`rtloop import`: recordings made of measurements of other programs."""

from __future__ import annotations

import errno
import re
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import FILES, JSON, OUTPUT, TARGET
from rtloop.cli.output import print_result
from rtloop.cli.output.progress import Counter
from rtloop.errors import OutputError
from rtloop.values import count_text
from rtloop.workbench.tables import console, escape, format_number, table

if TYPE_CHECKING:
    from rich.console import Console

    from rtloop.interchange.columns import ColumnSelection


LISTING_EXIT_CODE = 2
"""Exit code where a file was listed and no recording was written."""
SENSITIVITY = "FACTOR"
MAX_COLUMNS = 60
"""Columns of a file that are listed."""
MAX_SKIPPED = 10_000
SHOWN_COLUMNS = 12
"""Columns whose first and last rows are printed."""
EXAMPLE_SIGNALS = (("x_drive_v", "V"), ("x_position_um", "µm"))


class Extremes(TypedDict):
    """Least and largest finite value of a column or signal; None without one."""

    least: float | None
    largest: float | None


class Column(Extremes):
    """A column of a `ColumnListing`."""

    name: str
    unit: str | None
    grows_evenly: bool


class LineNumbers(click.ParamType):
    """Numbers of lines, such as 1-20,33."""

    name = "lines"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        """Return the numbers. Fails for any other text."""
        if not isinstance(value, str):
            return tuple(value)
        parts = [re.fullmatch(r"\s*(\d{1,7})(?:-(\d{1,7}))?\s*", part) for part in value.split(",")]
        ranges = [range(int(part[1]), int(part[2] or part[1]) + 1) for part in parts if part]
        if len(ranges) < len(parts) or not all(ranges) or sum(map(len, ranges)) > MAX_SKIPPED:
            self.fail(f"{value!r}; allowed: lines and ranges of lines, up to {MAX_SKIPPED}, such as 2 or 1-20,33")
        return tuple(dict.fromkeys(number for part in ranges for number in part))


class ColumnListing(dict[str, object]):
    """Report on the columns of a file, for which neither options nor a mapping name a signal."""


@click.command("import")
@FILES
@click.option(
    "--map",
    "maps",
    multiple=True,
    metavar="SIGNAL=COLUMN",
    help="Make SIGNAL from COLUMN; COLUMN alone: import the column unchanged.",
)
@click.option("--all", "everything", is_flag=True, help="Import the columns without --map too, under their own names.")
@click.option("--time", metavar="COLUMN", help="Column of times.  [default: found by its name]")
@click.option(
    "--rate",
    "rate_hz",
    type=click.FloatRange(1e-3, 1e6),
    metavar="HZ",
    help="Rate of the rows, in Hz, instead of --time.",
)
@click.option(
    "--position-first", is_flag=True,
    help="In each row, the position was sampled before the drive changed.  [default: both at the same time]",
)  # fmt: skip
@click.option(
    "--clock",
    metavar="COLUMN",
    help="Column of times of several; `stated`: the sample rate that FILE states instead of its times.",
)
@click.option("--time-unit", metavar="UNIT", help="Unit of the times, such as ms.  [default: as FILE says]")
@click.option("--header-row", type=click.IntRange(0), metavar="LINE", help="Line of the names, from 1; 0: no names.")
@click.option(
    "--skip-rows", type=LineNumbers(), default=(), metavar="LINES", help="Lines to leave out, such as 2 or 1-20,33."
)
@click.option("--delimiter", metavar="SIGN", help="Sign between columns: , ; | tab or blank.  [default: found]")
@click.option("--decimal", metavar="SIGN", help="Decimal sign: . or ,  [default: found]")
@click.option(
    "--dates", type=click.Choice(["day", "month"]), help="What dates with slashes begin with.  [default: found]"
)
@click.option(
    "--missing", multiple=True, metavar="TEXT", help="Text or number for a missing value; none: no usual one."
)
@click.option("--group", help="Raster, group or topic to import, if FILE has several.  [default: the longest]")
@click.option(
    "--mapping", type=OUTPUT, help="TOML file with these options.  [default: NAME.map.toml or map.toml beside FILE]"
)
@click.option("--out", type=TARGET, help="Recording to write; allowed with one FILE.  [default: FILE with .mcap]")
@JSON
@report_errors
def import_command(
    files: tuple[Path, ...],
    maps: tuple[str, ...],
    everything: bool,
    time: str | None,
    rate_hz: float | None,
    position_first: bool,
    group: str | None,
    mapping: Path | None,
    out: Path | None,
    as_json: bool,
    **answers: Any,
) -> int:
    """Make recordings of measurements of other programs.

    Reads MAT (also v7.3; ControlDesk, Simulink), text (CSV, LVM, Octave), npz, Parquet, HDF5, NetCDF, TDMS, MF4,
    Stabilizer's stream, and MCAP with numbers in it. Without a mapping, the command lists the columns of FILE, shows
    how to map them, and ends with exit code 2. If FILE has two readings, it ends with exit code 65 and names the option
    that decides.

    \b
      --map x_drive_v="Piezo Out [mV]"                    from mV to V, the unit in the signal's name
      --map x_drive_v="DAC [V] * 20"                      an amplifier of 20 V/V
      --map x_position_um="Sensor [V] * 2.5 µm/V - 3 µm"  a sensor's sensitivity, an offset
      --map "Temperature"                                 unchanged, under its own name

    Units in brackets replace the units of FILE. The other commands look for names ending in _drive_v, _position_um,
    _reference_um …; the first word is the axis.
    """
    from rtloop.interchange.columns import ColumnSelection, extend_selection

    if len(files) > 1 and (out is not None or as_json):
        raise click.UsageError(
            f"--out or --json with {len(files)} input files; allowed: one input file. "
            "Run the command once for each file"
        )
    if time is not None and rate_hz is not None:
        raise click.UsageError("--time and --rate: both are given; allowed: one of them")
    times = {"time": time, "rate_hz": rate_hz, "position_first": position_first}
    options = ColumnSelection(all=everything, group=group, **times, **answers)
    selection, code = extend_selection(maps, options), 0
    for file in files:
        with Counter("ticks imported", sys.stderr) as counter:
            report = import_file(file, selection, mapping, out, counter.show)
        for column in report["in_other_files"]:
            click.echo(f"{file}: column {column} is left out, because its values are stored in another file", err=True)
        is_listing = isinstance(report, ColumnListing)
        print_result(report, as_json, _print_listing if is_listing else _print_import)
        code = LISTING_EXIT_CODE if is_listing else code
    return code


def import_file(
    file: Path, selection: ColumnSelection, mapping: Path | None, output: Path | None, progress: Callable[[int], None]
) -> dict[str, Any]:
    """Make a recording of a file by `selection` and a mapping file.

    Returns the report of `import_data`, and under `mapping` the path of the mapping file or None. The options of
    `selection` override the mapping file. Where neither names a column, no recording is made and a `ColumnListing` is
    returned, unless `file` is an export of a recording. `mapping` None: a mapping file beside the data, unless
    `selection` names a column. `output` None: FILE with .mcap. `progress` receives the number of imported ticks. Raises
    UnreadableData, OutputError, MissingExtra as `import_data`; InputFileError, ConfigError for the mapping file.
    """
    from rtloop.interchange.columns import find_mapping, read_mapping
    from rtloop.interchange.importing import import_data, list_columns
    from rtloop.interchange.isolated_reader import read_table
    from rtloop.interchange.sampling import is_from_recording

    mapping_path = mapping or (None if selection else find_mapping(file))
    merged = selection if mapping_path is None else _merge_selections(selection, read_mapping(mapping_path))
    table = read_table(file, merged.hints)
    if not merged and not is_from_recording(table):
        return ColumnListing(list_columns(file, table, merged))
    try:
        report = import_data(file, merged, output, table=table, progress=progress)
    except OutputError as error:
        if error.number != errno.EEXIST:
            raise
        raise OutputError(f"{error}; use --out FILE to write another file", error.number) from None
    return report | {"mapping": None if mapping_path is None else str(mapping_path)}


def _merge_selections(options: ColumnSelection, mapping: ColumnSelection) -> ColumnSelection:
    """Return both selections as one; `options`, where they are set, have priority over `mapping`.

    A time or a rate in `options` replaces both of `mapping`.
    """
    overrides_time = options.time is not None or options.rate_hz is not None
    from rtloop.interchange.mapping import signal_name

    replaced = {signal_name(name) for name in options.signals}
    mapping_signals = {
        name: source
        for name, source in mapping.signals.items()
        if name in options.signals or signal_name(name) not in replaced
    }
    chosen = options.model_dump(exclude_defaults=True, exclude={"signals", "keep", "time", "rate_hz"})
    return mapping.model_copy(
        update=chosen
        | {"signals": {**mapping_signals, **options.signals}, "keep": (*mapping.keep, *options.keep)}
        | ({"time": options.time, "rate_hz": options.rate_hz} if overrides_time else {})
    )


def _print_import(report: Mapping[str, Any]) -> None:
    """Print the signals of a new recording, notes on them, its path and its length."""
    out = console()
    _print_description(out, report["about"])
    if report["mapping"]:
        out.print(f"mapping: {escape(report['mapping'])}")
    rows = [(s["name"], escape(s["unit"]), *_range_cells(s), escape(s["from"])) for s in report["signals"]]
    out.print(table("signal", "unit", "least", "largest", "made from", rows=rows, words=(4,)))
    _print_rows(out, report)
    _print_notes(out, report["notes"])
    length = f"{report['duration_s']:.6g} s at {report['rate_hz']:g} Hz, time: {escape(report['time'])}"
    out.print(f"{escape(report['output'])}: {count_text(report['ticks'], 'tick')}, {length}")


def _print_listing(report: Mapping[str, Any]) -> None:
    """Print the columns of a file, and an example of options that import it."""
    out = console()
    rate = f", {report['rate_hz']:g} Hz by {escape(report['time'])}" if report["rate_hz"] else ""
    out.print(f"[bold]{escape(report['file'])}[/]: {count_text(report['rows'], 'row')}{rate}")
    _print_description(out, report["about"])
    columns = report["columns"][:MAX_COLUMNS]
    rows = [(escape(column["name"]), escape(column["unit"] or "?"), *_range_cells(column)) for column in columns]
    out.print(table("column", "unit", "least", "largest", rows=rows))
    if len(report["columns"]) > MAX_COLUMNS:
        out.print(f"… and {count_text(len(report['columns']) - MAX_COLUMNS, 'column')} more; --json shows all columns")
    _print_rows(out, report)
    _print_notes(out, report["notes"])
    out.print("\nNothing was written. State the column and unit of each signal, for example:\n")
    time = "" if report["rate_hz"] else " --rate HZ"
    out.print(f"  rtloop import {escape(shlex.quote(report['file']))}{time} \\")
    example = _suggest_mapping(report["columns"], report["time_column"])
    maps = [f"--map {escape(shlex.quote(f'{name}={source}'))}" for name, source in example]
    out.print("    " + " \\\n    ".join(maps or ["--all"]))
    if any(f"{SENSITIVITY} " in source for _, source in example):
        out.print(f"\n{SENSITIVITY} is the factor of the sensor or amplifier, a number.")
    out.print("\nTo import every column unchanged, use --all. For all options: rtloop import --help")


def _suggest_mapping(columns: Sequence[Column], time: str | None) -> list[tuple[str, str]]:
    """Return (signal, "COLUMN [UNIT]") for each of EXAMPLE_SIGNALS, with another column each; fewer without columns.

    The unit is the column's own; one without a unit counts as in the signal's, and one of another kind is multiplied by
    a SENSITIVITY. The column is the first whose unit converts to the signal's, else the first without a unit, else the
    first of another kind; the column `time` and other clocks are left out. `columns` is the value of this key in a
    `ColumnListing`.
    """
    from rtloop.interchange.names import is_counter_name, name_without_unit
    from rtloop.interchange.units import is_unit

    candidates = [
        column
        for column in columns
        if column["name"] != time
        and not _is_clock(column)
        and not is_counter_name(column["unit"] or column["name"])
        and (not column["unit"] or is_unit(column["unit"]))
    ]
    suggestions: dict[str, str] = {}
    for is_fitting in (
        lambda column, unit: _converts(column["unit"], unit),
        lambda column, _: not column["unit"],
        None,
    ):
        for name, unit in EXAMPLE_SIGNALS:
            fitting = [c for c in candidates if name not in suggestions and (is_fitting is None or is_fitting(c, unit))]
            for column in fitting[:1]:
                candidates.remove(column)
                factor = f" * {SENSITIVITY} {unit}/{column['unit']}" if is_fitting is None else ""
                suggestions[name] = f"{name_without_unit(column['name'])} [{column['unit'] or unit}]{factor}"
    return [(name, suggestions[name]) for name, _ in EXAMPLE_SIGNALS if name in suggestions]


def _is_clock(column: Column) -> bool:
    """Whether a column of a `ColumnListing` has a unit of time, or no unit and values that grow evenly."""
    return _converts(column["unit"], "s") or (not column["unit"] and column["grows_evenly"])


def _converts(unit: str | None, target: str) -> bool:
    """Whether a unit is known and converts to `target`; False for None and ""."""
    from rtloop.interchange.units import UnknownUnit, factor_between

    try:
        return bool(unit) and bool(factor_between(unit or "", target))
    except UnknownUnit:
        return False


def _print_rows(out: Console, report: Mapping[str, Any]) -> None:
    """Print the first and the last rows as they were read, a line for each column."""
    rows = [*report["first_rows"], *report["last_rows"]]
    heads = [f"row {k + 1}" for k in range(len(report["first_rows"]))]
    heads += ["last but one", "last"][-len(report["last_rows"]) :] if report["last_rows"] else []
    names = [*rows[0]][:SHOWN_COLUMNS] if rows else []
    cells = [(escape(name), *(format_number(row[name], ".9g") for row in rows)) for name in names]
    out.print(table("as read", *heads, rows=cells))


def _range_cells(column: Extremes) -> tuple[str, str]:
    """Return the texts of a column's least and largest value; "–" for a value that is None."""
    return format_number(column["least"], ".6g"), format_number(column["largest"], ".6g")


def _print_description(out: Console, about: Mapping[str, str]) -> None:
    """Print the facts that a file states about itself, `about` by their names, one a line."""
    for name, text in about.items():
        out.print(f"{escape(name)}: {escape(text)}")


def _print_notes(out: Console, notes: list[str]) -> None:
    """Print notes on odd data, one a line."""
    for note in notes:
        out.print(f"[yellow]note[/]: {escape(note)}")
