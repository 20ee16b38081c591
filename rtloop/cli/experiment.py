"""`rtloop experiment`: run experiments, record them, report from the recordings alone."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypedDict, Unpack

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import CONFIG, JSON, OUTPUT, TARGET
from rtloop.cli.output import echo_json, print_warnings
from rtloop.cli.output.progress import StatusLine
from rtloop.cli.run import recover_leftovers
from rtloop.errors import LoopFault, RtloopError
from rtloop.workbench.tables import console, escape, table
from rtloop.workbench.written_files import write_outputs

if TYPE_CHECKING:
    from rtloop.experiments.planning import PlannedRun, Stage
    from rtloop.experiments.report import Report
    from rtloop.supervision.interruption import Interruption
    from rtloop.supervision.supervisor import RunResult

COLOURS = {"good": "green", "mixed": "yellow", "bad": "red", "": "default"}
RUN_OPTIONS = (
    CONFIG,
    click.option(
        "--set",
        "settings",
        metavar="EXPERIMENT.KEY=VALUE",
        multiple=True,
        help="Value of an experiment's parameter; `rtloop experiment list` shows all parameters.",
    ),
    click.option("--axis", help="Name of the axis; every other axis rests.  [default: the only axis]"),
    click.option(
        "--paced",
        is_flag=True,
        help="Run a simulated rig in real time, not in virtual time; hardware always runs in real time.",
    ),
    click.option(
        "--beside",
        "comparison",
        metavar="CONFIG",
        type=OUTPUT,
        help="Second configuration, with which the same experiments run; the report compares the results and the step "
        "responses of both.",
    ),
    click.option(
        "--out",
        type=TARGET,
        help="Folder for recordings and report.  [default: NAME-experiments-TIME in recording.folder]",
    ),
    JSON,
)


class RunOptions(TypedDict):
    """Values of RUN_OPTIONS, with the names that `run_experiments` gives them."""

    config: Path
    settings: Sequence[str]
    axis: str | None
    paced: bool
    comparison: Path | None
    out: Path | None
    as_json: bool


def run_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add RUN_OPTIONS to a command: the parameters of `run_experiments` except `names`. Returns the command."""
    for option in reversed(RUN_OPTIONS):
        command = option(command)
    return command


@click.group()
def experiment() -> None:
    """Run experiments on any driver, and report on them.

    Experiments characterise the stage and judge the loop.
    """


@experiment.command(name="list")
@report_errors
def list_experiments() -> None:
    """Show every experiment and its parameters."""
    from rtloop.experiments.registry import EXPERIMENTS

    out = console()
    for entry in EXPERIMENTS.values():
        out.print(f"[bold]{entry.name}[/]  {entry.title}")
        out.print(f"  {entry.description}")
        for name, field in entry.options.model_fields.items():
            value = list(field.default) if isinstance(field.default, tuple) else field.default
            text = "…  (default: chosen for the axis)" if value is None else value
            out.print(f"  --set {entry.name}.{name}={text}", style="dim", markup=False)


@experiment.command()
@click.argument("names", metavar="NAME...", nargs=-1, required=True)
@run_options
@report_errors
def run(names: tuple[str, ...], **options: Unpack[RunOptions]) -> int:
    """Run experiments on the driver of CONFIG, and report.

    Each experiment is recorded. It changes only mode, reference and schedule, and the simulated rig if its subject is
    the rig; limits and interlocks stay. Ctrl-C ramps down and reports the recorded runs. Exit 1 where an experiment
    could not be finished.
    """
    return run_experiments(names, **options)


@experiment.command(name="all")
@run_options
@report_errors
def run_all(**options: Unpack[RunOptions]) -> int:
    """Run every experiment that the driver of CONFIG allows.

    Records and reports as `rtloop experiment run`. Exit 1 where an experiment could not be finished.
    """
    from rtloop.experiments.registry import EXPERIMENTS

    return run_experiments(tuple(EXPERIMENTS), **options)


experiment.add_command(
    click.Command("paper", callback=run_all.callback, params=run_all.params, help=run_all.help, hidden=True)
)


@experiment.command()
@click.argument("runs", metavar="RUN...", type=OUTPUT, nargs=-1, required=True)
@click.option("--out", type=TARGET, help="Folder for the report.  [default: folder of the first recording]")
@JSON
@report_errors
def report(runs: tuple[Path, ...], out: Path | None, as_json: bool) -> int:
    """Analyse recordings of experiments again.

    Writes and prints the report. RUN is a recording or a folder of them. Exit 1 where the report is not complete.
    """
    from rtloop.recording.errors import RecordingError

    paths = [path for run in runs for path in (sorted(run.glob("*.mcap")) if run.is_dir() else [run])]
    if not paths:
        raise RecordingError(f"{', '.join(map(str, runs))}: no recording (*.mcap) found")
    return 0 if _report_recordings(paths, out or paths[0].parent, {}, as_json, {}) else LoopFault.exit_code


def run_experiments(
    names: Sequence[str],
    config: Path,
    settings: Sequence[str] = (),
    axis: str | None = None,
    paced: bool = False,
    comparison: Path | None = None,
    out: Path | None = None,
    as_json: bool = False,
) -> int:
    """Run the experiments `names` on the driver of `config`, record them, and write and print their report.

    Returns the exit code: 1 if a run failed or was interrupted, or the report is incomplete, else 0. `settings` are
    texts EXPERIMENT.KEY=VALUE; `axis` None is the only axis; `out` is the folder for recordings and report, by default
    NAME-experiments-TIME in `recording.folder`. `comparison` is a second configuration, with which the same experiments
    run with the same parameters; with `paced`, a driver that allows virtual time runs in real time, too. Raises
    ConfigError for unknown names, unsuitable settings or an invalid configuration; LoopFault if no experiment can be
    done, no run was recorded, or Ctrl-C ends the report; and the error of a first run that cannot start.
    """
    from rtloop.experiments.planning import plan_runs
    from rtloop.experiments.registry import parse_parameters, select_experiments
    from rtloop.supervision.interruption import Interruption

    experiments = select_experiments(names)
    stage = _load_stage(config, axis)
    base = stage.base
    folder = out or Path(base.recording.folder) / f"{base.name}-experiments-{time.strftime('%Y%m%dT%H%M%S')}"
    parameters = parse_parameters(experiments, settings)
    other_stage = None if comparison is None else _load_stage(comparison, stage.setting.axis.name)
    planned_runs, skipped = plan_runs(experiments, parameters, stage, folder, compared=other_stage)
    if comparison is not None and other_stage is not None:
        fitted = {planned.experiment.name: planned.options for planned in planned_runs}
        comparable = [entry for entry in experiments if entry.name in fitted]
        comparison_runs, comparison_skipped = plan_runs(comparable, fitted, other_stage, folder, is_comparison=True)
        planned_runs += comparison_runs
        skipped |= {f"{name} with {comparison.name}": reason for name, reason in comparison_skipped.items()}
    if not planned_runs:
        raise LoopFault(
            "\n  ".join(["no experiment can run. Reasons:", *(f"{n}: {why}" for n, why in skipped.items())])
        )
    with Interruption() as interruption:
        paths, problems = _record_all(planned_runs, folder, paced or stage.prepared.facts.real, interruption)
    for problem in problems:
        click.echo(f"rtloop: {problem}", err=True)
    if interruption.requested:
        click.echo(
            "rtloop: interrupted. The outputs are parked (at their safe values). The report covers the recorded runs",
            err=True,
        )
    if not paths:
        raise LoopFault("nothing was recorded")
    extra = {"interrupted": interruption.requested, "skipped": skipped}
    try:
        is_complete = _report_recordings(paths, folder, skipped, as_json, extra)
    except KeyboardInterrupt:
        remedy = f"To write the report from the recordings: `rtloop experiment report {folder}`"
        raise LoopFault(f"interrupted; no report was written. {remedy}") from None
    return 0 if is_complete and not interruption.requested and not problems else LoopFault.exit_code


def _load_stage(config: Path, axis: str | None) -> Stage:
    """Load a configuration and print its warnings. Returns the Stage of `axis` (None: the only axis).

    Raises ConfigError for an invalid configuration, an unknown axis, and several axes without a choice; InputFileError
    for a file that cannot be read, DriverError for a missing library.
    """
    from rtloop.experiments.planning import load_stage

    stage = load_stage(config, axis)
    print_warnings(stage.prepared.warnings)
    return stage


def _record_all(
    planned_runs: Sequence[PlannedRun], folder: Path, paced: bool, interruption: Interruption
) -> tuple[list[Path], list[str]]:
    """Record run after run until one fails or the user interrupts. Returns recordings and problems, one sentence each.

    A run that is planned from the recording of a finished run follows it at once. A run that ends with an error is a
    problem. The error of a run that cannot start or be planned is raised if no run is recorded yet, else it is a
    problem, too.
    """
    from rtloop.drivers.errors import DriverError

    paths: list[Path] = []
    problems: list[str] = []
    with RunsProgress(sum(planned.run.timeline.ticks for planned in planned_runs), sys.stderr) as progress:
        queue = list(planned_runs)
        while queue and not interruption.requested:
            planned = queue.pop(0)
            try:
                result = _record(planned, folder, paced, interruption, progress)
                paths += result.recordings
                if result.error:
                    problems.append(f"{planned.label}: {result.error}")
                    break
                if planned.plan_next and (next_run := planned.plan_next(paths)):
                    progress.add_run(next_run.run.timeline.ticks)
                    queue.insert(0, next_run)
            except (RtloopError, DriverError) as error:
                if not paths:
                    raise
                problems.append(f"{planned.label}: {error}")
                break
    return paths, problems


def _record(
    planned: PlannedRun, folder: Path, paced: bool, interruption: Interruption, progress: RunsProgress
) -> RunResult:
    """Recover recordings of killed runs in `folder`, run the loop once, recorded in `folder`, and return the result.

    Shows the run's progress, and lets `interruption` stop it. Raises RtloopError or DriverError if it cannot start.
    """
    from rtloop.configuration.prepare import prepare
    from rtloop.supervision.recording_path import new_recording_path
    from rtloop.supervision.supervisor import Processes, Supervisor

    ticks, configuration = planned.run.timeline.ticks, planned.configuration
    with Processes() as processes:
        prepared = prepare(configuration, duration_s=ticks / configuration.loop.rate_hz, paced=paced)
        path = new_recording_path(prepared, folder)
        recover_leftovers(path.parent)
        supervisor = Supervisor(processes, prepared, path)
        interruption.set_supervisor(supervisor)
        try:
            result = supervisor.run(lambda supervisor: progress.show(planned.label, supervisor.ticks, ticks))
        finally:
            interruption.set_supervisor(None)
    progress.finish_run(ticks)
    return result


def _report_recordings(
    paths: Sequence[Path], folder: Path, skipped: Mapping[str, str], as_json: bool, extra: Mapping[str, object]
) -> bool:
    """Write the report of recordings to `folder`; print it, in JSON with `extra`. Returns whether it is complete.

    `skipped` are the reasons why experiments were left out, by the experiment's name. Raises RecordingError for
    unreadable recordings, OutputError for files that cannot be written.
    """
    from rtloop.experiments.report import load_runs, make_report

    with StatusLine("reading", sys.stderr) as status:
        recorded_runs = load_runs(paths)
        report = make_report(recorded_runs, status.update)
    recordings = {path.name: path for recorded_run in recorded_runs for path in recorded_run.paths}
    files = _write_report(report, recordings, folder, skipped)
    with suppress(BrokenPipeError):
        if as_json:
            echo_json({**report.content, **extra, "files": [str(file) for file in files]})
        else:
            _print_report(report.content, skipped)
            click.echo(files[0])
    return report.is_complete


def _write_report(
    report: Report, recordings: Mapping[str, Path], folder: Path, skipped: Mapping[str, str]
) -> list[Path]:
    """Write report.html, report.json and a PNG of each picture in each theme to `folder`; return the paths, HTML first.

    Existing files are overwritten. `recordings` are the paths, by file name, to which the HTML page links; `skipped`
    are reasons by experiment. Raises OutputError if a file cannot be written; the files before it remain.
    """
    from rtloop.experiments.page import render_report

    links = {name: os.path.relpath(path.resolve(), folder.resolve()) for name, path in recordings.items()}
    contents = {
        "report.html": render_report(report.content, report.pictures, links, skipped).encode(),
        "report.json": (json.dumps(report.content, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode(),
        **{f"{name}-{theme}.png": png for name, files in report.pictures.items() for theme, png in files.items()},
    }
    return write_outputs(folder, contents)


class RunsProgress(StatusLine):
    """A status line with the present run, its share, the share of all runs, and an estimate of the remaining time."""

    def __init__(self, total_ticks: int, stream: IO[str]) -> None:
        """Begin with the planned runs, of `total_ticks` ticks together; without a terminal, no line is shown."""
        super().__init__("starting", stream)
        self._total_ticks, self._done_ticks = total_ticks, 0
        self._start_s = time.monotonic()

    def show(self, label: str, ticks: int, planned_ticks: int) -> None:
        """Show that `ticks` of the `planned_ticks` of the present run, named `label`, are done."""
        ticks = min(ticks, planned_ticks)
        done_ticks = self._done_ticks + ticks
        remaining = ""
        if done_ticks:
            elapsed_s = time.monotonic() - self._start_s
            remaining = f"about {_duration_text(elapsed_s * (self._total_ticks - done_ticks) / done_ticks)} left"
        total_percent = 100 * done_ticks // self._total_ticks
        self.update(f"{label}: {100 * ticks // planned_ticks} %   all: {total_percent} %   {remaining}")

    def add_run(self, ticks: int) -> None:
        """Add a further run of `ticks` ticks, which was not planned at the start, to the total."""
        self._total_ticks += ticks

    def finish_run(self, planned_ticks: int) -> None:
        """Count the present run, of `planned_ticks` ticks, as finished, even if it ended early."""
        self._done_ticks += planned_ticks


def _duration_text(seconds: float) -> str:
    """Return a duration as text: `2 min 05 s`, below a minute `48 s`, an hour and more `125 min 00 s`."""
    minutes, remainder_s = divmod(round(seconds), 60)
    return f"{minutes} min {remainder_s:02d} s" if minutes else f"{remainder_s} s"


def _print_report(content: Mapping[str, Any], skipped: Mapping[str, str]) -> None:
    """Print the verdicts of every experiment in a report's `content`, then the reasons for skipped experiments.

    The notes of an experiment are printed if a verdict misses or differs; the notes on middle and reduced defaults
    always. `skipped` are the reasons by the experiment's name.
    """
    from rtloop.experiments.page import HEADINGS, comparison_cell, comparison_keys, format_number, second_value_cell

    out = console()
    for section in content["experiments"]:
        out.print(f"[bold]{section['title']}[/]")
        if section["problem"]:
            out.print(f"  [red]{escape(section['problem'])}[/]")
            continue
        keys = comparison_keys(section["rows"])
        other_heading = [f"{content['beside']} gave"] if content["beside"] else []
        rows = table("", *(HEADINGS[key] for key in keys), "this run gave", *other_heading, "verdict")
        rows.columns[-1].justify = "left"
        for row in section["rows"]:
            unit = "" if row["unit"] == "1" else f" {row['unit']}"
            cells = [escape(comparison_cell(row, key)) for key in keys]
            cells.append("–" if row["run"] is None else format_number(row["run"]) + unit)
            cells += [second_value_cell(row)] if other_heading else []
            rows.add_row(f"  {row['quantity']}", *cells, f"[{COLOURS[row['mark']]}]{escape(row['verdict'])}[/]")
        out.print(rows)
        is_explained = any(row["mark"] not in ("good", "") for row in section["rows"])
        setup_notes = len(section["reduced"]) + bool(section["middle_um"])
        for note in section["notes"] if is_explained else section["notes"][:setup_notes]:
            out.print(f"  {escape(note)}")
    for name, reason in skipped.items():
        out.print(f"[bold]{name}[/] skipped: {escape(reason)}")
