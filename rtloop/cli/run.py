"""`rtloop run`: run the loop of a configuration and record every tick."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

from rtloop import signals
from rtloop.cli.exit_codes import report_errors, require_readable
from rtloop.cli.info import print_summary
from rtloop.cli.options import CONFIG, JSON, OUTPUT, Seconds
from rtloop.cli.output import echo_json, print_warnings
from rtloop.cli.output.progress import Counter, StatusLine
from rtloop.cli.output.tables import console, escape, format_figure, table
from rtloop.cli.panel import panel_options, panel_process
from rtloop.errors import LoopFault, RtloopError
from rtloop.signals import Mode
from rtloop.values import count_text

if TYPE_CHECKING:
    from rtloop.configuration.axis import AxisOptions
    from rtloop.configuration.file import Configuration
    from rtloop.configuration.prepare import Prepared
    from rtloop.recording.views.summary import Summary
    from rtloop.supervision.interruption import Interruption
    from rtloop.supervision.supervisor import RunResult, Supervisor

STEP_QUANTITIES = ("overshoot_percent", "settling_ms", "static_error_percent")
"""Keys of a specification, in the order of the table's columns."""
MAX_STEP_ANALYSIS_TICKS = 6_000_000
SHOWN_AXES = 4


@click.command()
@CONFIG
@click.option("--duration", "duration_s", type=Seconds(), help="Seconds to run, rounded to whole ticks [until Ctrl-C].")
@click.option(
    "--unpaced", is_flag=True, help="Run in virtual time, as fast as the machine allows (simulated hardware only)."
)
@click.option("--out", type=OUTPUT, help="Folder for the recording [recording.folder].")
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
    """Run the loop of CONFIG and record every tick.

    Ctrl-C ramps down, finishes the recording and ends with exit code 0. With --panel the loop runs as with
    `rtloop serve`, with a control socket.
    """
    require_readable(config)
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
    """Run a configuration, record and summarise the run. Returns the exit code: 1 also after a trip.

    `paced` is False for virtual time. The imports take a second; `interruption` catches a Ctrl-C meanwhile, and then no
    loop is started. Raises RtloopError, DriverError if the run cannot start.
    """
    from rtloop.configuration.cautions import option_cautions
    from rtloop.configuration.file import load
    from rtloop.configuration.prepare import prepare
    from rtloop.foundation.native.cache import CACHE_FOLDER, CACHE_IS_PERSISTENT
    from rtloop.recording.views.summary import summarise
    from rtloop.supervision.recording_path import new_recording_path
    from rtloop.supervision.supervisor import Processes, Supervisor

    with Processes() as processes:
        prepared = prepare(load(config), duration_s=duration_s, paced=paced)
        warnings = [*prepared.warnings, *option_cautions(prepared)]
        cache = (
            f"no cache folder can be written: compiled code is in {CACHE_FOLDER}, and is compiled again once that "
            "folder is deleted"
        )
        print_warnings([*warnings, *(() if CACHE_IS_PERSISTENT else (cache,))])
        path = new_recording_path(prepared, out)
        recover_leftovers(path.parent)
        if interruption.requested:
            click.echo("stopped before the loop began: nothing was driven, nothing is recorded", err=True)
            if as_json:
                echo_json({"outcome": "stopped", "recording": None, "recordings": []})
            return 0
        supervisor = Supervisor(processes, prepared, path)
        interruption.set_supervisor(supervisor)
        with RunView(prepared, sys.stderr) as view:
            result = supervisor.run(view.show)
        interruption.set_supervisor(None)
    summary = summarise(result.recordings) if result.recordings else None
    if as_json:
        echo_json(_run_report(summary, result, warnings, supervisor.startup_s))
    else:
        _print_run(prepared, summary)
    for note in result.notes:
        click.echo(f"note: {note}", err=True)
    if result.error:
        click.echo(f"rtloop: {result.error}", err=True)
    return result.exit_code or (LoopFault.exit_code if summary and summary.trips else 0)


def _run_report(
    summary: Summary | None, result: RunResult, warnings: list[str], startup_s: float | None
) -> dict[str, Any]:
    """Return the JSON report: the recording's summary, if there is a recording, and the result of the run."""
    return {"trips": [], **(summary.as_dict() if summary else {"recording": None})} | {
        "recordings": [str(path) for path in result.recordings],
        "notes": list(result.notes),
        "outcome": result.outcome,
        "error": result.error,
        "recorder": result.recorder,
        "warnings": warnings,
        "startup_s": startup_s,
    }


def recover_leftovers(folder: Path) -> None:
    """Complete the recordings that killed runs left in `folder`; print one line each. The old files stay.

    A recording that cannot be recovered gives a warning.
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
        """Show the newest tick of a running loop; nothing without a terminal or before the first tick."""
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


def _print_run(prepared: Prepared, summary: Summary | None) -> None:
    """Print the summary of a run, and its steps where the reference has some. `summary` is None without a recording."""
    if summary is None:
        console().print("nothing is recorded")
        return
    print_summary(summary)
    if 0 < summary.ticks_logged <= MAX_STEP_ANALYSIS_TICKS and not summary.trips:
        _print_steps(prepared, summary.recording)


def _print_steps(prepared: Prepared, recording: str) -> None:
    """Print overshoot (%), settling time (ms) and static error (%) of each axis's steps, the worst and the median.

    Only ticks in the modes feedforward and closed_loop count, whose reference is in µm. Limits and claims of the axis's
    specification follow.
    """
    import numpy as np

    from rtloop.recording.load import load
    from rtloop.recording.views.steps import SETTLING_BAND, step_metrics

    samples = load(recording)
    rows = table("steps", "overshoot %", "settling ms (5 %)", "static error %")
    is_in_um = np.isin(samples["mode"], (Mode.FEEDFORWARD, Mode.CLOSED_LOOP))
    for axis in prepared.configuration.axes:
        name, rate_hz = axis.name, prepared.plan.pacing.rate_hz
        reference_um, position_um = (samples[f"{name}_{signal}_um"][is_in_um] for signal in ("reference", "position"))
        metrics = step_metrics(reference_um, position_um, rate_hz)
        if metrics is None:
            continue
        for label, suffix in ((f"worst of {metrics.steps}", "_worst"), ("median", "")):
            overshoot, settling, error = (
                getattr(metrics, f"{quantity}{suffix}")
                for quantity in ("overshoot_percent", "settling_time_ms", "static_error_percent")
            )
            figures = (format_figure(overshoot, 2), format_figure(settling, 2), format_figure(error, 3))
            rows.add_row(f"{name}: {label}", *figures)
        if metrics.unreached:
            rows.add_row(f"  [red]{metrics.unreached} of {metrics.steps} steps hardly moved, or ended more than "
                          f"{100 * SETTLING_BAND:g} % of their height from the reference[/]")  # fmt: skip
        for label, values in _specification_rows(prepared.configuration, axis):
            rows.add_row(label, *values)
    if rows.row_count:
        console().print(rows)


def _specification_rows(configuration: Configuration, axis: AxisOptions) -> Iterator[tuple[str, list[str]]]:
    """Yield labels and cells: the limits of an axis's specification, and the figures that it claims, if any.

    Yields one row with the error for a specification that cannot be read.
    """
    if axis.specification is None:
        return
    from rtloop.design.synthesis.specification_file import load_specification  # slow, and seldom needed

    name = escape(axis.specification)
    try:
        specification = load_specification(configuration.folder / axis.specification).design.specification
    except RtloopError as error:
        yield f"  [red]{escape(error)}[/]", []
        return
    limits = [getattr(specification, key) for key in STEP_QUANTITIES]
    yield f"  {name} asks", ["–" if limit is None else f"≤ {limit:g}" for limit in limits]
    if specification.claims:
        yield f"  {name} claims", [escape(specification.claim_words(key)) or "–" for key in STEP_QUANTITIES]
