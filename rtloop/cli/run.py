"""`rtloop run`: run the loop of a configuration and record every tick."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

import click

from rtloop import signals
from rtloop.cli.exit_codes import report_errors, require_readable
from rtloop.cli.options import CONFIG, JSON, TARGET, Seconds
from rtloop.cli.output import echo_json, print_warnings
from rtloop.cli.output.progress import Counter, StatusLine
from rtloop.cli.panel import panel_options, panel_process
from rtloop.errors import RtloopError
from rtloop.signals import Mode
from rtloop.values import count_text
from rtloop.workbench.tables import console

if TYPE_CHECKING:
    from rtloop.configuration.prepare import Prepared
    from rtloop.supervision.interruption import Interruption
    from rtloop.supervision.supervisor import Supervisor

SHOWN_AXES = 4


@click.command()
@CONFIG
@click.option(
    "--duration",
    "duration_s",
    type=Seconds(),
    help="Duration of the run, rounded to whole ticks.  [default: until Ctrl-C]",
)
@click.option(
    "--unpaced", is_flag=True, help="Run in virtual time, as fast as the machine allows (simulated hardware only)."
)
@click.option("--out", type=TARGET, help="Folder for the recording.  [default: recording.folder]")
@JSON
@panel_options
@report_errors
def run(
    config: Path,
    duration_s: float | None,
    unpaced: bool,
    out: Path | None,
    as_json: bool,
    panel: bool,
    panel_port: int,
) -> int:
    """Run the loop of CONFIG and record it.

    Every tick is recorded, or those near events if recording.around is set.

    Ctrl-C ramps down, finishes the recording and ends with exit code 0. With --panel the loop runs as with
    `rtloop serve`, with a control socket.
    """
    require_readable(config)
    if out is not None and out.suffix == ".mcap":
        raise click.UsageError(
            f"--out: {out} is a recording's name; allowed: a folder. rtloop names the recording by date and time"
        )
    if panel:
        if unpaced or out is not None or as_json:
            raise click.UsageError("--panel: not allowed with --unpaced, --out or --json")
        from rtloop.service.daemon import serve

        with panel_process(config, panel, panel_port):
            return serve(config, duration_s)
    from rtloop.supervision.interruption import Interruption

    with Interruption() as interruption:
        return run_configuration(config, duration_s, not unpaced, out, as_json, interruption)


def run_configuration(
    config: Path, duration_s: float | None, paced: bool, out: Path | None, as_json: bool, interruption: Interruption
) -> int:
    """Run a configuration, record it and print the result. Returns `RunResult.exit_code`: 0 for a good run and for one
    that did not begin, 1 also after a trip, else the code of the failure.

    `paced` is False for virtual time. The imports take a second; `interruption` catches a Ctrl-C meanwhile, and then no
    loop is started. Raises RtloopError, DriverError if the run cannot start.
    """
    from rtloop.workbench.run import run_loop

    result = run_loop(config, duration_s, paced, out, interruption, TerminalObserver())
    if result.supervised is None:
        click.echo("stopped before the loop began: nothing was driven, nothing is recorded", err=True)
    if as_json:
        echo_json(result.as_dict())
    elif result.supervised is not None:
        result.print_text(console())
    for note in result.notes:
        click.echo(f"note: {note}", err=True)
    if result.error:
        click.echo(f"rtloop: {result.error}", err=True)
    return result.exit_code


class TerminalObserver:
    """Receiver of the stages of a run, which prints them on stderr."""

    def warn(self, warnings: Sequence[str]) -> None:
        """Print the warnings about the configuration on stderr, each as a line "warning: TEXT"."""
        print_warnings(warnings)

    def recover_leftovers(self, folder: Path) -> None:
        """Complete the recordings that killed runs left in `folder`, and print one line each on stderr."""
        recover_leftovers(folder)

    @contextmanager
    def watch(self, prepared: Prepared) -> Iterator[Callable[[Supervisor], None]]:
        """Show a status line while the loop runs; the context gives the function that updates it.

        Before the first start on a machine, a line first states that code is compiled.
        """
        from rtloop.starters.first_start import FIRST_START, is_first_start

        if is_first_start():
            click.echo(FIRST_START, err=True)
        with RunView(prepared, sys.stderr) as view:
            yield view.show


def recover_leftovers(folder: Path) -> None:
    """Complete the recordings that killed runs left in `folder`, *.mcap.part; print one line each on stderr.

    The old files stay. A recording that cannot be recovered gives a warning on stderr, and no error.
    """
    from rtloop.foundation.trusted import open_own
    from rtloop.recording.file.recover import find_leftovers, recover

    for part in find_leftovers(folder):
        try:
            with Counter("ticks recovered", sys.stderr) as counter:
                report = recover(part, progress=counter.show, opener=open_own)
        except RtloopError as error:
            print_warnings([error])
            continue
        click.echo(
            f"{report['output']}: {count_text(report['ticks'], 'tick')} recovered from {part.name}, which is kept",
            err=True,
        )
        print_warnings(f"{part}: {problem}" for problem in report["problems"])


class RunView(StatusLine):
    """A status line with time, mode, lateness and axes of the newest tick."""

    def __init__(self, prepared: Prepared, stream: IO[str]) -> None:
        """Begin with the text "starting"; without a terminal on `stream`, no line is shown."""
        super().__init__("starting", stream)
        self._plan = prepared.plan

    def show(self, supervisor: Supervisor) -> None:
        """Show the newest tick of a running loop; no effect without a terminal or before the first tick."""
        row = supervisor.latest() if self._status else None
        if row is None:
            return
        plan, rate_hz = self._plan, self._plan.pacing.rate_hz
        end = "s" if plan.ticks is None else f"of {plan.ticks / rate_hz:g} s"
        parts = [f"{row[signals.TICK] / rate_hz:8.1f} {end}", Mode(int(row[signals.MODE])).name.lower()]
        if causes := signals.trip_causes(row[signals.FLAGS]):
            parts.append(f"[red]tripped: {', '.join(causes)}[/]")
        if plan.pacing.paced:
            parts.append(f"late {row[signals.LATENESS]:6.1f} µs")
        for axis, name in enumerate(plan.axes[:SHOWN_AXES]):
            position, drive = (row[signals.axis_column(axis, signal)] for signal in (signals.POSITION, signals.DRIVE))
            parts.append(f"{name} {position:8.3f} µm {drive:7.3f} V")
        self.update("   ".join(parts))
