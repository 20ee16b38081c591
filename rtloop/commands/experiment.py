"""`rtloop experiment`: run procedures with the loop as it is, and report from the recordings alone."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import click

from rtloop.commands.output import write_over
from rtloop.commands.run import recover_leftovers
from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.file import Configuration, load
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.design.synthesis.specification import SpecificationOptions
from rtloop.design.synthesis.specification_file import load_specification
from rtloop.drivers.errors import DriverError
from rtloop.errors import ConfigError, LoopFault, RtloopError
from rtloop.experiments.derive import derive_configuration, store_tables
from rtloop.experiments.page import render_report
from rtloop.experiments.procedure import Experiment, UnsuitableLoop
from rtloop.experiments.registry import parse_parameters, select_experiments
from rtloop.experiments.report import Report, load_runs, make_report
from rtloop.experiments.setting import Setting
from rtloop.experiments.timeline import Run
from rtloop.foundation.options import Options
from rtloop.hil.options import RigOptions
from rtloop.recording.errors import RecordingError
from rtloop.supervision.interruption import Interruption
from rtloop.supervision.recording_path import new_recording_path
from rtloop.supervision.supervisor import Processes, RunResult, Supervisor
from rtloop.terminal.experiments import Progress, print_report
from rtloop.terminal.machine import echo_json
from rtloop.terminal.progress import StatusLine


class Stage(NamedTuple):
    """A configuration, and what experiments may know of it."""

    base: Configuration
    prepared: Prepared
    setting: Setting


class Planned(NamedTuple):
    """One run with the configuration that it is made with; `further` is what follows from recordings, if anything."""

    experiment: Experiment
    options: Options
    run: Run
    configuration: Configuration
    further: Callable[[Sequence[Path]], Planned | None] | None = None

    @property
    def label(self) -> str:
        """For people."""
        return f"{self.experiment.name} {self.run.label}".rstrip()


def run_experiments(
    names: Sequence[str], config: Path, settings: Sequence[str], axis: str | None, paced: bool, out: Path | None,
    as_json: bool, beside: Path | None = None,
) -> int:  # fmt: skip
    """Run, record, report; returns the exit code. Raises ConfigError and what `rtloop run` raises.

    `beside` is another configuration that does the same experiments with the same parameters.
    """
    experiments = select_experiments(names)
    stage = _stage(config, axis)
    folder = (
        out or Path(stage.base.recording.folder) / f"{stage.base.name}-experiments-{time.strftime('%Y%m%dT%H%M%S')}"
    )
    planned, skipped = _plan(experiments, parse_parameters(experiments, settings), stage, folder, beside=False)
    if beside is not None:
        fixed = {one.experiment.name: one.options for one in planned}
        compared = [one for one in experiments if one.name in fixed]
        other, without = _plan(compared, fixed, _stage(beside, stage.setting.axis.name), folder, beside=True)
        planned += other
        skipped |= {f"{name} with {beside.name}": reason for name, reason in without.items()}
    prepared = stage.prepared
    if not planned:
        raise LoopFault("\n  ".join(["no experiment can be done", *(f"{n}: {why}" for n, why in skipped.items())]))
    with Interruption() as interruption:
        paths, problems = _record_all(planned, folder, paced or prepared.facts.real, interruption)
    for problem in problems:
        click.echo(f"rtloop: {problem}", err=True)
    if interruption.requested:
        click.echo("rtloop: interrupted; outputs are parked, and what was recorded is reported", err=True)
    if not paths:
        raise LoopFault("nothing was recorded")
    try:
        made, files = _write(take_and_report(paths), folder, skipped)
    except KeyboardInterrupt:
        hint = f"`rtloop experiment report {folder}` makes it from the recordings"
        raise LoopFault(f"interrupted, and the report left out: {hint}") from None
    whole = made.is_complete and not interruption.requested and not problems
    _show(made, files, skipped, as_json, {"interrupted": interruption.requested, "skipped": skipped})
    return 0 if whole else LoopFault.exit_code


def report_recordings(runs: Sequence[Path], out: Path | None, as_json: bool) -> int:
    """The report of recordings that were made before. Raises RecordingError, OutputError."""
    paths = _recordings(runs)
    made, files = _write(take_and_report(paths), out or paths[0].parent, {})
    _show(made, files, {}, as_json, {})
    return 0 if made.is_complete else LoopFault.exit_code


def take_and_report(paths: Sequence[Path]) -> tuple[Report, dict[str, Path]]:
    """The report, and each recording's path by its name."""
    with StatusLine("reading", sys.stderr) as status:
        takings = load_runs(paths)
        made = make_report(takings, status.update)
    return made, {path.name: path for taken in takings for path in taken.paths}


def _stage(config: Path, axis: str | None) -> Stage:
    """What is configured; warnings are said. Raises ConfigError."""
    base = load(config)
    prepared = prepare(base)
    for warning in prepared.warnings:
        click.echo(f"warning: {warning}", err=True)
    about = _axis(base, axis)
    setting = Setting(base.loop.rate_hz, about, is_virgin=not prepared.facts.real, specification=_asked(base, about))
    return Stage(base, prepared, setting)


def _plan(
    experiments: Sequence[Experiment], options: Mapping[str, Options], stage: Stage, folder: Path, *, beside: bool
) -> tuple[list[Planned], dict[str, str]]:
    """Runs, and why there are none by experiment."""
    skipped = _unsuitable(experiments, stage.prepared, stage.setting.axis)
    planned: list[Planned] = []
    for experiment in experiments:
        if experiment.name in skipped:
            continue
        try:
            planned += _planned(experiment, options[experiment.name], stage, folder, beside)
        except UnsuitableLoop as reason:
            skipped[experiment.name] = str(reason)
    return planned, skipped


def _axis(base: Configuration, name: str | None) -> AxisOptions:
    names = [axis.name for axis in base.axes]
    if name is None and len(names) > 1:
        raise ConfigError(base.source, [f"it has the axes {', '.join(names)}: --axis says which one is meant"])
    if name is not None and name not in names:
        raise ConfigError(base.source, [f"--axis {name}: there is no such axis; there are {', '.join(names)}"])
    return next(axis for axis in base.axes if name in (None, axis.name))


def _unsuitable(experiments: Sequence[Experiment], prepared: Prepared, axis: AxisOptions) -> dict[str, str]:
    """Reasons by experiment. A rig that is no real hardware is built anew for each run, and can be another one."""
    rig = isinstance(prepared.configuration.driver_options, RigOptions) and not prepared.facts.real
    reasons = {one.name: one.unsuitable_reason(prepared.configuration, axis, rig) for one in experiments}
    return {name: reason for name, reason in reasons.items() if reason is not None}


def _planned(experiment: Experiment, asked_for: Options, stage: Stage, folder: Path, beside: bool) -> list[Planned]:
    """The runs of an experiment; the last one goes on where the experiment does."""
    base, setting = stage.base, stage.setting
    options = experiment.fit_options(asked_for, setting)
    if beside and options != asked_for:
        raise UnsuitableLoop(
            f"axis.{setting.axis.name}: its limits allow less than what it is to be compared with does"
        )
    runs = experiment.runs(options, setting)
    values, asked = (
        options.model_dump(mode="json"),
        setting.specification.model_dump(mode="json", exclude_defaults=True),
    )

    def made(run: Run, last: bool) -> Planned:
        store_tables(run, folder / base.name)
        configuration = derive_configuration(
            base, setting.axis.name, experiment.name, values, run, len(runs), asked, beside
        )
        return Planned(experiment, options, run, configuration, further if last and experiment.next_run else None)

    def further(paths: Sequence[Path]) -> Planned | None:
        assert experiment.next_run is not None
        mine = [one for one in load_runs(paths) if (one.experiment, one.is_comparison) == (experiment.name, beside)]
        run = experiment.next_run(mine, options, setting)
        return None if run is None else made(run, True)

    return [made(run, run is runs[-1]) for run in runs]


def _asked(base: Configuration, axis: AxisOptions) -> SpecificationOptions:
    """What the specification that the axis names asks of its loop; nothing where it names none."""
    if axis.specification is None:
        return SpecificationOptions()
    return load_specification(base.folder / axis.specification).design.specification


def _record_all(
    planned: Sequence[Planned], folder: Path, paced: bool, interruption: Interruption
) -> tuple[list[Path], list[str]]:
    """Run after run until something goes wrong; recordings, and what it was. Raises what prevents the first run."""
    paths: list[Path] = []
    problems: list[str] = []
    with Progress(sum(one.run.timeline.ticks for one in planned), sys.stderr) as progress:
        waiting = list(planned)
        while waiting and not interruption.requested:
            one = waiting.pop(0)
            try:
                result = _record(one, folder, paced, interruption, progress)
            except (RtloopError, DriverError) as error:
                if not paths:
                    raise
                problems.append(f"{one.label}: {error}")
                break
            paths += result.recordings
            if result.error:
                problems.append(f"{one.label}: {result.error}")
                break
            if one.further and (another := one.further(paths)):
                progress.more(another.run.timeline.ticks)
                waiting.insert(0, another)
    return paths, problems


def _record(one: Planned, folder: Path, paced: bool, interruption: Interruption, progress: Progress) -> RunResult:
    """One run of the normal loop."""
    timeline = one.run.timeline
    with Processes() as processes:
        prepared = prepare(one.configuration, duration_s=timeline.ticks / one.configuration.loop.rate_hz, paced=paced)
        path = new_recording_path(prepared, folder)
        recover_leftovers(path.parent)
        supervisor = Supervisor(processes, prepared, path)
        interruption.set_supervisor(supervisor)
        try:
            result = supervisor.run(lambda supervisor: progress.show(one.label, supervisor.ticks, timeline.ticks))
        finally:
            interruption.set_supervisor(None)
    progress.finished(timeline.ticks)
    return result


def _recordings(runs: Sequence[Path]) -> list[Path]:
    """The files that are meant, and those of experiments in the folders that are. Raises RecordingError."""
    found: list[Path] = []
    for run in runs:
        found += sorted(run.glob("*.mcap")) if run.is_dir() else [run]
    if not found:
        raise RecordingError(f"{', '.join(map(str, runs))}: holds no recording (*.mcap)")
    return found


def _write(
    taken: tuple[Report, Mapping[str, Path]], folder: Path, skipped: Mapping[str, str]
) -> tuple[Report, list[Path]]:
    """report.html, report.json and a PNG of each picture in each theme."""
    made, recordings = taken
    links = {name: os.path.relpath(path.resolve(), folder.resolve()) for name, path in recordings.items()}
    contents = {
        "report.html": render_report(made.content, made.pictures, links, skipped).encode(),
        "report.json": (json.dumps(made.content, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode(),
        **{f"{name}-{theme}.png": png for name, files in made.pictures.items() for theme, png in files.items()},
    }
    for name, content in contents.items():
        write_over(folder / name, content)
    return made, [folder / name for name in contents]


def _show(made: Report, files: Sequence[Path], skipped: Mapping[str, str], as_json: bool, more: dict[str, Any]) -> None:
    with suppress(BrokenPipeError):
        if as_json:
            echo_json({**made.content, **more, "files": [str(file) for file in files]})
            return
        print_report(made.content, skipped)
        click.echo(files[0])
