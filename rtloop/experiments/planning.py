"""Runs that an experiment needs on a configuration's driver, each with the configuration that it is made with."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.file import Configuration, load
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.configuration.rig import driver_delay_ticks, rig_options
from rtloop.configuration.simulated import sensor_ends_um, sensor_reach_um
from rtloop.design.synthesis.specification import SpecificationOptions
from rtloop.design.synthesis.specification_file import load_axis_specification
from rtloop.errors import ConfigError
from rtloop.experiments.derive import derive_configuration, store_tables
from rtloop.experiments.procedure import Experiment, UnsuitableLoop
from rtloop.experiments.report import load_runs
from rtloop.experiments.setting import Setting
from rtloop.experiments.timeline import Run
from rtloop.foundation.options import Options


class Stage(NamedTuple):
    """A configuration, and the facts about it that experiments may use."""

    base: Configuration
    prepared: Prepared
    setting: Setting


class PlannedRun(NamedTuple):
    """Run of an experiment, with its options and its configuration.

    `plan_next` takes the paths of the recordings so far, returns the run that follows from them, and None at the end;
    it is None itself where no run follows.
    """

    experiment: Experiment
    options: Options
    run: Run
    configuration: Configuration
    plan_next: Callable[[Sequence[Path]], PlannedRun | None] | None = None

    @property
    def label(self) -> str:
        """Name of experiment and run, for progress and messages."""
        return f"{self.experiment.name} {self.run.label}".rstrip()


def load_stage(config: Path, axis: str | None) -> Stage:
    """Return the Stage of a configuration for experiments on `axis` (None: the only axis), with its specification.

    The specification is empty if the axis names no specification file. Raises ConfigError for an invalid configuration
    or specification, an unknown axis, and several axes without a choice; InputFileError for a file that cannot be read,
    DriverError for a missing library.
    """
    base = load(config)
    prepared = prepare(base)
    selected = _select_axis(base, axis)
    specification = SpecificationOptions()
    if selected.specification is not None:
        specification = load_axis_specification(base, selected).design.specification
    setting = Setting(
        base.loop.rate_hz, selected, not prepared.facts.real, specification, sensor_reach_um(base, selected),
        sensor_ends_um(base, selected), driver_delay_ticks(base),
    )  # fmt: skip
    return Stage(base, prepared, setting)


def plan_runs(
    experiments: Sequence[Experiment],
    options: Mapping[str, Options],
    stage: Stage,
    folder: Path,
    *,
    compared: Stage | None = None,
    is_comparison: bool = False,
) -> tuple[list[PlannedRun], dict[str, str]]:
    """Plan the runs of every suitable experiment, and store the tables that these runs play below `folder`.

    `options` are by the experiment's name. Defaults are fitted to the limits of `stage` and, where the experiment can
    be done on `compared`, to the limits of `compared` as well. `is_comparison`: `stage` is of the second configuration
    (`--beside`), and the options are used unchanged. Returns the planned runs and, by the experiment's name, the
    reasons why other experiments are skipped. Raises ConfigError for options that the axis's limits or the experiment
    do not allow and for an invalid configuration of a run, OutputError if a table cannot be written.
    """
    planned_runs: list[PlannedRun] = []
    skipped: dict[str, str] = {}
    for experiment in experiments:
        try:
            if (reason := _unsuitable_reason(experiment, stage)) is not None:
                raise UnsuitableLoop(reason)
            fitted, reductions = options[experiment.name], list[str]()
            if not is_comparison:
                is_compared = compared and _unsuitable_reason(experiment, compared) is None
                other_setting = compared.setting if compared and is_compared else None
                reductions = experiment.reductions(fitted, stage.setting, other_setting)
                fitted = experiment.fit_options(fitted, stage.setting, other_setting)
            planned_runs += _plan_experiment(experiment, fitted, stage, folder, reductions, is_comparison)
        except UnsuitableLoop as unsuitable:
            skipped[experiment.name] = str(unsuitable)
    return planned_runs, skipped


def _select_axis(base: Configuration, name: str | None) -> AxisOptions:
    """Return the options of the axis `name`, or of the only axis for None.

    Raises ConfigError for an unknown name, and for None with several axes.
    """
    names = [axis.name for axis in base.axes]
    if name is None and len(names) > 1:
        raise ConfigError(
            base.source, [f"the configuration has several axes, {', '.join(names)}; select one with --axis"]
        )
    if name is not None and name not in names:
        raise ConfigError(base.source, [f"--axis {name}: there is no such axis; allowed: {', '.join(names)}"])
    return next(axis for axis in base.axes if name in (None, axis.name))


def _unsuitable_reason(experiment: Experiment, stage: Stage) -> str | None:
    """Return why an experiment cannot be done on a stage; None where it can."""
    configuration = stage.prepared.configuration
    # Only a simulated rig is built anew for each run, and can be another one.
    is_rig = rig_options(configuration) is not None and not stage.prepared.facts.real
    return experiment.unsuitable_reason(configuration, stage.setting.axis, is_rig)


def _plan_experiment(
    experiment: Experiment, options: Options, stage: Stage, folder: Path, reductions: list[str], is_comparison: bool
) -> list[PlannedRun]:
    """Return the planned runs of one experiment, and store their tables.

    Only the last run has `plan_next`, and only if the experiment has `next_run`. `reductions` has a text for each
    default that a limit reduced, for the report. Raises UnsuitableLoop if the loop does not allow the experiment,
    ConfigError for options that the experiment refuses and for an invalid configuration of a run, OutputError if a
    table cannot be written.
    """
    base, setting = stage.base, stage.setting
    runs = experiment.runs(options, setting)
    values = options.model_dump(mode="json")
    specification = setting.specification.model_dump(mode="json", exclude_defaults=True)

    def plan_run(run: Run, is_last: bool) -> PlannedRun:
        """Store the tables of samples that a run plays, and return the run with its configuration.

        The tables become npy files; the run's references, changed in place, name them. The result has `plan_next` if
        `is_last`. Raises OutputError if a file cannot be written, ConfigError for an invalid configuration.
        """
        store_tables(run, folder / base.name)
        configuration = derive_configuration(
            base, setting.axis.name, experiment.name, values, run, len(runs), specification, is_comparison, reductions
        )
        return PlannedRun(experiment, options, run, configuration, plan_next if is_last else None)

    def plan_next(paths: Sequence[Path]) -> PlannedRun | None:
        """Plan the run that follows from the recordings at `paths`, in any order, and store its tables; None at the
        end.

        Runs of other experiments, and of the other configuration of a comparison, are ignored. Raises RecordingError
        for an unreadable file and for a recording that was not made by an experiment, UnsuitableData for a run that
        tripped, was clipped or is not whole, UnsuitableLoop as the experiment's `next_run`, OutputError for a table
        that cannot be written, ConfigError for an invalid configuration of the run.
        """
        recorded_runs = [
            run for run in load_runs(paths) if (run.experiment, run.is_comparison) == (experiment.name, is_comparison)
        ]
        for recorded in recorded_runs:
            recorded.require_complete()
        run = experiment.next_run(recorded_runs, options, setting) if experiment.next_run else None
        return None if run is None else plan_run(run, True)

    return [plan_run(run, run is runs[-1] and experiment.next_run is not None) for run in runs]
