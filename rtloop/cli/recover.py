"""`rtloop recover` and `rtloop cut`: a new recording made of a damaged one, or of a stretch of one."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import FILES, JSON, TARGET, Seconds
from rtloop.cli.output import print_result
from rtloop.cli.output.progress import Counter
from rtloop.values import count_text
from rtloop.workbench.tables import console, escape, print_problems

if TYPE_CHECKING:
    from rich.console import Console

TICK = click.IntRange(min=0)


@click.command()
@FILES
@click.option(
    "--out",
    type=TARGET,
    help="Recovered file to write; allowed with one FILE.  [default: NAME.mcap for NAME.mcap.part]",
)
@JSON
@report_errors
def recover(files: tuple[Path, ...], out: Path | None, as_json: bool) -> None:
    """Make a whole file of a damaged recording.

    For a run that was killed, or a file that is cut off or damaged. The original file stays unchanged.
    """
    from rtloop.recording.file.recover import recover as recover_recording
    from rtloop.recording.file.run_readers import find_files

    paths = find_files(files)
    if len(paths) > 1 and (out is not None or as_json):
        raise click.UsageError(
            f"--out or --json with {len(paths)} input files; allowed: one input file. "
            "Run the command once for each file"
        )
    for path in paths:
        with Counter("ticks recovered", sys.stderr) as counter:
            report = recover_recording(path, out, counter.show)
        print_result(report, as_json, _print_recovery)


@click.command()
@FILES
@click.option(
    "--from",
    "from_s",
    type=Seconds(allows_zero=True),
    help="Beginning of the part, in s since the start of the run.  [default: start of the run]",
)
@click.option(
    "--until",
    "until_s",
    type=Seconds(),
    help="End of the part, in s since the start of the run.  [default: end of the run]",
)
@click.option("--from-tick", "first", type=TICK, metavar="TICK", help="First tick of the part, instead of --from.")
@click.option("--until-tick", "end", type=TICK, metavar="TICK", help="First tick after the part, instead of --until.")
@click.option("--out", type=TARGET, help="Recording to write.  [default: NAME.cut-TICK.mcap beside FILE]")
@JSON
@report_errors
def cut(
    files: tuple[Path, ...],
    from_s: float | None,
    until_s: float | None,
    first: int | None,
    end: int | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Cut a stretch out of a recording, as a recording that replays.

    The new recording begins at the last snapshot of the law's state before the stretch, at most a second earlier.
    FILE may still grow (NAME.mcap.part); FILE stays unchanged, and every tick is copied bit for bit.
    """
    from rtloop.recording.cutting.cut import cut as cut_recording

    for seconds, tick, name in ((from_s, first, "from"), (until_s, end, "until")):
        if seconds is not None and tick is not None:
            raise click.UsageError(f"--{name} and --{name}-tick: both are given; allowed: one of them")
    with Counter("ticks copied", sys.stderr) as counter:
        report = cut_recording(files, first, end, out, from_s=from_s, until_s=until_s, progress=counter.show)
    print_result(report, as_json, _print_cut)


def _print_recovery(report: dict[str, Any]) -> None:
    """Print the number of recovered ticks, gaps and problems, or that the recording was complete."""
    out, original, output = console(), escape(report["recording"]), escape(report["output"])
    if report["complete"] and not report["gaps"] and not report["problems"]:
        out.print(f"{original} is complete, nothing had to be recovered; {output} is a copy")
        return
    out.print(f"{output}: {count_text(report['ticks'], 'tick')} recovered from {original}")
    _print_gaps(out, report)
    if not report["complete"]:
        out.print("the end of the run is missing: the ticks after the last recovered tick are unknown")


def _print_cut(report: dict[str, Any]) -> None:
    """Print the range of ticks in the new recording, its missing ticks and problems."""
    out = console()
    span = f"ticks {report['first']} to {report['end'] - 1}"
    if report["begin"] < report["first"]:
        span += f", preceded by ticks {report['begin']} to {report['first'] - 1}, which a replay needs"
    ticks = count_text(report["ticks"], "tick")
    out.print(f"{escape(report['output'])}: {ticks} of {escape(report['recording'])}: {span}")
    _print_gaps(out, report)


def _print_gaps(out: Console, report: dict[str, Any]) -> None:
    """Print each gap (missing ticks) and each problem of a report in a line to `out`."""
    for first, count in report["gaps"]:
        out.print(f"missing: {count_text(count, 'tick')} from tick {first} on")
    print_problems(out, report["problems"])
