"""`rtloop archive`: thousands of recordings replayed or summarised, with one table of verdicts."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import JSON, OUTPUT, TARGET
from rtloop.cli.output import print_result
from rtloop.cli.output.progress import Counter
from rtloop.cli.workers import choose_workers, worker_options
from rtloop.errors import LoopFault
from rtloop.values import count_text
from rtloop.workbench.tables import console, escape, format_number, table

if TYPE_CHECKING:
    from rtloop.campaigns.archive_verdict import Examination

STOPPED = 130
"""Exit code of a call that Ctrl-C has stopped."""
HEADINGS = {"duration_s": "duration s"}
WORDS = ("column", "trips")
"""Columns of text, which are aligned to the left."""


def _add_options(command: Callable[..., object]) -> Callable[..., object]:
    """Add to a command the argument PATTERN and the options of all commands of `archive`. Returns the command."""
    for option in (
        JSON,
        click.option(
            "--out",
            type=TARGET,
            help="Folder for the verdicts, from which the same command continues after a stop.  [default: none]",
        ),
        worker_options,
        click.argument("patterns", metavar="PATTERN...", type=OUTPUT, nargs=-1, required=True),
    ):
        command = option(command)
    return command


@click.group()
def archive() -> None:
    """Replay or summarise thousands of recordings.

    PATTERN is a recording, a folder with all recordings below it, or a pattern in quotes, such as 'archive/**/*.mcap',
    where ** stands for any number of folders. The files of a rotated run count as one recording.
    """


@archive.command()
@_add_options
@report_errors
def replay(patterns: tuple[Path, ...], jobs: int | None, scheduler: str | None, out: Path | None, as_json: bool) -> int:
    """Replay each recording, and list all that are not identical.

    The verdict of a recording is identical, differs (at a tick, in a column), damaged, not verified, unfinished, other
    version, no law, cannot be read, or crashed its worker. After Ctrl-C, the replays that run are finished, and no
    other begins.

    Exit 1 if a recording is not identical.
    """
    from rtloop.campaigns.archive_verdict import REPLAY

    return _examine(REPLAY, patterns, jobs, scheduler, out, as_json)


@archive.command()
@_add_options
@report_errors
def info(patterns: tuple[Path, ...], jobs: int | None, scheduler: str | None, out: Path | None, as_json: bool) -> int:
    """Summarise each recording in one line.

    The line has number of ticks, duration, lost ticks, trips, and the verdict: readable, damaged, unfinished, other
    version, cannot be read, or crashed its worker. After Ctrl-C, the recordings that are being read are finished, and
    no other begins.

    Exit 1 if a recording is not readable.
    """
    from rtloop.campaigns.archive_verdict import INFO

    return _examine(INFO, patterns, jobs, scheduler, out, as_json)


def _examine(
    examination: Examination,
    patterns: tuple[Path, ...],
    jobs: int | None,
    scheduler: str | None,
    out: Path | None,
    as_json: bool,
) -> int:
    """Examine the recordings that `patterns` name, print the table of verdicts, and return the exit code.

    The code is STOPPED if Ctrl-C left recordings out, 1 if a recording's verdict is not the good one, else 0. `jobs` is
    the number of worker processes, `scheduler` the address of a Dask scheduler in place of them, `out` the folder that
    stores the verdicts; each may be None. Raises UsageError for both `jobs` and `scheduler`, and the errors of
    `find_recordings`, `examine` and `DaskWorkers`.
    """
    from rtloop.supervision.interruption import Interruption

    with Interruption() as interruption, choose_workers(jobs, scheduler, "rtloop.campaigns.archive_verdict") as workers:
        from rtloop.campaigns.archive import examine
        from rtloop.campaigns.archive_files import find_recordings

        recordings = find_recordings(patterns)
        click.echo(f"{count_text(len(recordings), 'recording')} on {workers.name}", err=True)
        with Counter(f"of {len(recordings):,} recordings", sys.stderr) as counter:
            report = examine(examination, recordings, workers, out, counter.show, lambda: interruption.requested)
    print_result(report, as_json, lambda report: _print_report(report, examination.columns, examination.good_verdict))
    if report["pending"]:
        remedy = (
            "To continue, run the same command again"
            if out
            else "Without --out FOLDER, the same command begins with all recordings again"
        )
        click.echo(f"stopped, {count_text(report['pending'], 'recording')} not examined yet. {remedy}", err=True)
        return STOPPED
    return LoopFault.exit_code if set(report["counts"]) - {examination.good_verdict} else 0


def _print_report(report: Mapping[str, Any], columns: tuple[str, ...], good_verdict: str) -> None:
    """Print a row for each recording, then the number of recordings by verdict, the duration and the rate.

    `columns` are the keys of a verdict that are shown. If "tick" is among them, as for a replay, a recording with
    `good_verdict` and without a reason has no row.
    """
    out = console()
    rows = [
        row for row in report["verdicts"] if "tick" not in columns or row["verdict"] != good_verdict or row["reason"]
    ]
    if rows:
        cells = [
            (_path_text(row), escape(row["verdict"]), *(_cell(row[name]) for name in columns), escape(row["reason"]))
            for row in rows
        ]
        words = (1, *(2 + place for place, name in enumerate(columns) if name in WORDS), 2 + len(columns))
        out.print(table("recording", "verdict", *(HEADINGS.get(name, name) for name in columns), "reason",
                        rows=cells, words=words))  # fmt: skip
    counts = ", ".join(f"{count:,} {verdict}" for verdict, count in report["counts"].items())
    done = report["recordings"] - report["pending"] - report["stored"]
    stored = f", {report['stored']:,} stored earlier, unchanged by their SHA-256" if report["stored"] else ""
    out.print(f"{count_text(report['recordings'], 'recording')}: {counts or 'no verdict'}")
    out.print(f"{done:,} in {report['duration_s']:.1f} s, {report['rate_per_s']:.1f} recordings/s{stored}")


def _path_text(row: Mapping[str, Any]) -> str:
    """Return the path of a row's recording as text for rich, with its number of files if there are several.

    The path is relative if it lies below the current folder. "?" replaces characters that cannot be printed.
    """
    path = os.path.relpath(row["path"])
    path = row["path"] if path.startswith("..") else path
    path = "".join(letter if letter.isprintable() else "?" for letter in path)
    return escape(path) + (f" ({row['files']} files)" if row["files"] > 1 else "")


def _cell(value: object) -> str:
    """Return a value of a row as text for rich: a list of trips as "tick 5: CAUSE, CAUSE; …", "" for None."""
    if isinstance(value, list):
        return "; ".join(f"tick {trip['tick']}: {', '.join(trip['causes'])}" for trip in value)
    if isinstance(value, float):
        return format_number(value, ".3f")
    return "" if value is None else escape(value)
