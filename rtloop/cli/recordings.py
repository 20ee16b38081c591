"""Commands on recordings. FILE is a recording, a pattern, or the parts of a rotated one."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from rtloop.cli.options import FILES, JSON, OUTPUT, Seconds, fails_clearly
from rtloop.terminal.machine import echo_json

TICK = click.IntRange(min=0)
TO = click.Choice(["csv", "parquet", "npz", "mat", "hdf5"])


@click.command()
@FILES
@JSON
@fails_clearly
def info(files: tuple[Path, ...], as_json: bool) -> int:
    """Show what a recording holds.

    Completeness, timing, errors, drives. The parts of a rotated recording count as one.
    """
    from rtloop.recording.views.summary import summarise
    from rtloop.terminal.progress import Counter
    from rtloop.terminal.run import print_summary

    with Counter("ticks read", sys.stderr) as counter:
        summary = summarise(files, counter.show)
    if as_json:
        echo_json(summary.as_dict())
    else:
        print_summary(summary)
    return 0


@click.command()
@FILES
@click.option("--config", "other", type=OUTPUT, help="The law of this configuration on the recorded inputs instead.")
@click.option("--resimulate", is_flag=True, help="The recorded reference in closed loop with the simulated rig.")
@click.option("--law", "laws", type=OUTPUT, multiple=True, help="File with a law that ran, where it is not installed.")
@click.option("--trust-recorded-law", is_flag=True, help="Run the laws' code that the recording holds: if it is yours.")
@JSON
@fails_clearly
def replay(
    files: tuple[Path, ...],
    other: Path | None,
    resimulate: bool,
    laws: tuple[Path, ...],
    trust_recorded_law: bool,
    as_json: bool,
) -> int:
    """Execute a recording again and compare it in bytes.

    Every output of every tick; exit 1 where one differs.

    With --config: what another law would have commanded on the same inputs, from rest. With --resimulate: how it
    would have followed the recorded reference on the simulated rig of its configuration (without --config: the
    recorded law and rig). Both end with 0.
    """
    from rtloop.commands.replay import replay_on_the_rig, replay_with_other_law, trust_in
    from rtloop.recording.load import load
    from rtloop.recording.replay.replay import replay as replay_recording
    from rtloop.terminal.progress import Counter
    from rtloop.terminal.recordings import print_differences, print_replay, print_resimulation

    trust = trust_in(laws, trust_recorded_law)
    with Counter("ticks replayed", sys.stderr) as counter:
        if resimulate:
            beside = replay_on_the_rig(files, other, counter.show, trust)
            _show(beside, as_json, print_resimulation)
            return 0
        if other is not None:
            differences = replay_with_other_law(files, other, counter.show)
            _show(differences, as_json, print_differences)
            return 0
        report = replay_recording(load(files), counter.show, trust)
    _show(report.as_dict(), as_json, lambda _: print_replay(files[0], report))
    return 0 if report.identical else 1


@click.command()
@FILES
@click.option("--out", type=OUTPUT, help="The recovered file (of one FILE) [NAME.mcap for NAME.mcap.part].")
@JSON
@fails_clearly
def recover(files: tuple[Path, ...], out: Path | None, as_json: bool) -> int:
    """Make a whole file of a damaged recording.

    It was killed, cut off or damaged; the original stays as it is.
    """
    from rtloop.recording.file.recover import recover as recover_recording
    from rtloop.recording.file.run_readers import find_files
    from rtloop.terminal.progress import Counter
    from rtloop.terminal.recordings import print_recovery

    paths = find_files(files)
    if len(paths) > 1 and (out is not None or as_json):
        raise click.UsageError("--out and --json are for one FILE")
    for path in paths:
        with Counter("ticks recovered", sys.stderr) as counter:
            report = recover_recording(path, out, counter.show)
        _show(report, as_json, print_recovery)
    return 0


@click.command()
@FILES
@click.option("--from", "from_s", type=Seconds(zero=True), help="Seconds since the start of the run [its beginning].")
@click.option("--until", "until_s", type=Seconds(), help="Seconds since the start of the run [its end].")
@click.option("--from-tick", "first", type=TICK, metavar="TICK", help="The first tick, instead of --from.")
@click.option("--until-tick", "end", type=TICK, metavar="TICK", help="The tick behind the last, instead of --until.")
@click.option("--out", type=OUTPUT, help="The recording to write [NAME.cut-TICK.mcap beside FILE].")
@JSON
@fails_clearly
def cut(
    files: tuple[Path, ...],
    from_s: float | None,
    until_s: float | None,
    first: int | None,
    end: int | None,
    out: Path | None,
    as_json: bool,
) -> int:
    """Make a recording of a stretch of one, which replays by itself.

    It begins at the newest state of the law in front of the stretch, at most a second before. FILE may still grow
    (NAME.mcap.part); it stays as it is, and every tick is copied bit for bit.
    """
    from rtloop.recording.cutting.cut import cut as cut_recording
    from rtloop.terminal.progress import Counter
    from rtloop.terminal.recordings import print_cut

    for seconds, tick, name in ((from_s, first, "from"), (until_s, end, "until")):
        if seconds is not None and tick is not None:
            raise click.UsageError(f"--{name} and --{name}-tick: one of them is allowed")
    with Counter("ticks copied", sys.stderr) as counter:
        report = cut_recording(files, first, end, out, from_s=from_s, until_s=until_s, progress=counter.show)
    _show(report, as_json, print_cut)
    return 0


@click.command()
@FILES
@click.option("--to", type=TO, required=True, help="Format; all but csv, npz and mat need the extra 'data'.")
@click.option("--out", type=OUTPUT, help="The file to write [FILE with another ending].")
@click.option("--from", "start_s", type=Seconds(zero=True), default=0.0, help="Seconds since the start of the run.")
@click.option("--until", "end_s", type=Seconds(), default=None, help="Seconds since the start of the run.")
@click.option("--every", type=click.IntRange(min=1), default=1, metavar="N", help="One tick of N, as it is: no mean.")
@click.option(
    "--signals", default="", metavar="A,B,…", help="Only these; x_* is a pattern. tick and deadline_ns come along."
)
@JSON
@fails_clearly
def export(
    files: tuple[Path, ...],
    to: str,
    out: Path | None,
    start_s: float,
    end_s: float | None,
    every: int,
    signals: str,
    as_json: bool,
) -> int:
    """Write a recording as CSV, Parquet, npz, HDF5 or MAT.

    Every number exactly, and never over an existing file. MAT files are laid out as dSPACE ControlDesk's: scripts that
    read NAME.X.Data and NAME.Y(k).Data work unchanged; NAME is that of the file. They are of version 5, which holds
    up to 2 GiB.
    """
    from rtloop.interchange.export import export as export_recording
    from rtloop.recording.views.selection import Selection
    from rtloop.terminal.progress import Counter
    from rtloop.terminal.recordings import print_export

    with Counter("ticks exported", sys.stderr) as counter:
        wanted = tuple(filter(None, (name.strip() for name in signals.split(","))))
        selection = Selection(wanted, start_s, math.inf if end_s is None else end_s, every)
        report = export_recording(files, to, out, counter.show, selection)
    _show(report, as_json, print_export)
    return 0


@click.command()
@FILES
@click.option("--out", type=OUTPUT, help="The picture to write: .png, .pdf or .svg [FILE with .png].")
@click.option("--from", "start_s", type=Seconds(zero=True), default=0.0, help="Seconds since the start of the run.")
@click.option("--until", "end_s", type=Seconds(), default=None, help="Seconds since the start of the run.")
@click.option("--html", is_flag=True, help="One self-contained page to zoom and pan in, instead of a PNG.")
@JSON
@fails_clearly
def plot(
    files: tuple[Path, ...], out: Path | None, start_s: float, end_s: float | None, html: bool, as_json: bool
) -> int:
    """Draw signals, timing and events of a recording."""
    from rtloop.recording.load import load
    from rtloop.recording.views.page import write_page
    from rtloop.recording.views.plot import plot as plot_recording
    from rtloop.terminal.progress import Counter

    draw, recording = write_page if html else plot_recording, load(files)
    with Counter("ticks read", sys.stderr) as counter:
        end_s = math.inf if end_s is None else end_s
        picture = draw(recording, out, start_s=start_s, end_s=end_s, progress=counter.show)
    for problem in recording.problems:
        click.echo(f"problem: {problem}", err=True)
    report = {"recording": str(files[0]), "output": str(picture), "problems": recording.problems}
    _show(report, as_json, lambda _: click.echo(picture))
    return 0


def _show(result: dict[str, Any], as_json: bool, for_people: Callable[[dict[str, Any]], None]) -> None:
    """One JSON object, or words."""
    if as_json:
        echo_json(result)
    else:
        for_people(result)


COMMANDS = (info, replay, cut, recover, export, plot)
