"""`rtloop export` and `rtloop plot`: a recording in other file formats, and as a picture."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import FILES, JSON, TARGET, Seconds
from rtloop.cli.output import print_result
from rtloop.cli.output.progress import Counter
from rtloop.values import count_text
from rtloop.workbench.tables import console, escape, print_problems

FORMAT = click.Choice(["csv", "parquet", "npz", "mat", "hdf5"])
FROM = click.option(
    "--from",
    "start_s",
    type=Seconds(allows_zero=True),
    default=0.0,
    help="Beginning of the part, in s since the start of the run.  [default: 0]",
)
UNTIL = click.option(
    "--until",
    "end_s",
    type=Seconds(),
    default=None,
    help="End of the part, in s since the start of the run.  [default: end of the run]",
)


@click.command()
@FILES
@click.option(
    "--to", type=FORMAT, help="Format of the file; parquet and hdf5 need rtloop[data].  [default: by --out's ending]"
)
@click.option("--out", type=TARGET, help="File to write.  [default: FILE with another ending]")
@FROM
@UNTIL
@click.option(
    "--every", type=click.IntRange(min=1), default=1, metavar="N", help="Write every N-th tick, without averaging."
)
@click.option(
    "--signals",
    default="",
    metavar="A,B,…",
    help="Export only these signals, besides tick and deadline_ns; * stands for any text, as in x_*.",
)
@JSON
@report_errors
def export(
    files: tuple[Path, ...],
    to: str | None,
    out: Path | None,
    start_s: float,
    end_s: float | None,
    every: int,
    signals: str,
    as_json: bool,
) -> None:
    """Write a recording as CSV, Parquet, npz, HDF5 or MAT.

    Every number is written exactly; an existing file is never overwritten. MAT files have the layout of dSPACE
    ControlDesk: scripts that read NAME.X.Data and NAME.Y(k).Data work unchanged; NAME is the name of the file. The
    format of MAT files is version 5, which holds up to 2 GiB.
    """
    from rtloop.interchange.export import EXPORT_SUFFIXES
    from rtloop.interchange.export import export as export_recording
    from rtloop.recording.views.selection import Selection

    formats = {suffix: name for name, suffix in EXPORT_SUFFIXES.items()}
    to = to or (None if out is None else formats.get(out.suffix.lower()))
    if to is None:
        raise click.UsageError(f"the format is open; give --to, or --out with one of the endings {', '.join(formats)}")
    with Counter("ticks exported", sys.stderr) as counter:
        names = tuple(filter(None, (name.strip() for name in signals.split(","))))
        selection = Selection(names, start_s, math.inf if end_s is None else end_s, every)
        report = export_recording(files, to, out, counter.show, selection)
    print_result(report, as_json, _print_export)


@click.command()
@FILES
@click.option("--out", type=TARGET, help="Picture to write: .png, .pdf or .svg.  [default: FILE with .png]")
@FROM
@UNTIL
@click.option("--html", is_flag=True, help="Write one HTML page with zoom and pan, instead of a PNG.")
@JSON
@report_errors
def plot(
    files: tuple[Path, ...], out: Path | None, start_s: float, end_s: float | None, html: bool, as_json: bool
) -> None:
    """Draw signals, timing and events of a recording.

    Writes a picture, or with --html a page, over an existing one, and prints its path. Problems of the recording are
    printed on stderr.
    """
    from rtloop.recording.load import load
    from rtloop.recording.views.page import write_page
    from rtloop.recording.views.plot import plot as plot_recording

    draw, recording = write_page if html else plot_recording, load(files)
    end_s = math.inf if end_s is None else end_s
    with Counter("ticks read", sys.stderr) as counter:
        picture = draw(recording, out, start_s=start_s, end_s=end_s, progress=counter.show)
    for problem in recording.problems:
        click.echo(f"problem: {problem}", err=True)
    report = {"recording": str(files[0]), "output": str(picture), "problems": recording.problems}
    print_result(report, as_json, lambda _: click.echo(picture))


def _print_export(report: dict[str, Any]) -> None:
    """Print path and size of the exported file, and problems of the recording."""
    out = console()
    out.print(f"{escape(report['output'])}: {count_text(report['ticks'], 'tick')}, {report['bytes'] / 2**20:.1f} MiB")
    print_problems(out, report["problems"])
