"""The command that takes other programs' files in."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from rtloop.cli.options import FILES, JSON, OUTPUT, fails_clearly
from rtloop.terminal.machine import echo_json

NOTHING_WANTED = 2
"""Exit code where a file was only shown."""


@click.command("import")
@FILES
@click.option(
    "--map", "maps", multiple=True, metavar="SIGNAL=COLUMN", help="A signal from a column; COLUMN alone: as it is."
)
@click.option("--all", "everything", is_flag=True, help="All other columns too, under their own names.")
@click.option("--time", metavar="COLUMN", help="The column of times [the one that is called so].")
@click.option(
    "--rate", "rate_hz", type=click.FloatRange(1e-3, 1e6), metavar="HZ", help="Count by a rate, instead of --time."
)
@click.option("--group", help="Which raster, group or topic, where FILE has several [the longest].")
@click.option("--mapping", type=OUTPUT, help="TOML file that says all this [NAME.map.toml or map.toml beside FILE].")
@click.option("--out", type=OUTPUT, help="The recording to write, of one FILE [FILE with .mcap].")
@JSON
@fails_clearly
def import_command(
    files: tuple[Path, ...],
    maps: tuple[str, ...],
    everything: bool,
    time: str | None,
    rate_hz: float | None,
    group: str | None,
    mapping: Path | None,
    out: Path | None,
    as_json: bool,
) -> int:
    """Make recordings of measurements of other programs.

    Of MAT (v7.3 too; ControlDesk, Simulink), CSV, npz, Parquet, HDF5, and MCAP with numbers in it. Without a mapping it
    shows what is in FILE, and how to map it, and ends with 2.

    \b
      --map x_drive_v="Piezo Out [mV]"                    converted to V by the names
      --map x_drive_v="DAC [V] * 20"                      an amplifier of 20 V/V
      --map x_position_um="Sensor [V] * 2.5 µm/V - 3 µm"  a sensor's sensitivity, an offset
      --map "Temperature"                                 as it is, under its own name

    Units in brackets go before those of FILE. Names ending in _drive_v, _position_um, _reference_um … are what the
    other commands look for; the first word is the axis.
    """
    from rtloop.commands.importing import Shown, import_file
    from rtloop.interchange.columns import ColumnSelection, extend_selection
    from rtloop.terminal.interchange import print_import, print_listing
    from rtloop.terminal.progress import Counter

    if len(files) > 1 and (out is not None or as_json):
        raise click.UsageError("--out and --json are for one FILE")
    if time is not None and rate_hz is not None:
        raise click.UsageError("--time and --rate: one of them is allowed")
    given, code = (
        extend_selection(maps, ColumnSelection(all=everything, time=time, rate_hz=rate_hz, group=group)),
        0,
    )
    for file in files:
        with Counter("ticks imported", sys.stderr) as counter:
            report = import_file(file, given, mapping, out, counter.show)
        for left in report["in_other_files"]:
            click.echo(f"{file}: {left}: left out, for its values are not in this file", err=True)
        if as_json:
            echo_json(report)
        elif isinstance(report, Shown):
            print_listing(report)
        else:
            print_import(report)
        code = NOTHING_WANTED if isinstance(report, Shown) else code
    return code


COMMANDS = (import_command,)
"""What comes in from other programs."""
