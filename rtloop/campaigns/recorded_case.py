"""Recordings of single rigs: the same loop with the recorder beside it, for a rig that is worth a look."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rtloop.campaigns.case import CaseRunner
from rtloop.campaigns.rig_experiments import Experiment
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.errors import output_errors
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.reader import Reader
from rtloop.supervision.supervisor import Processes, Supervisor


def record_rig(runner: CaseRunner, rig: int, folder: Path) -> list[Path]:
    """Run all experiments of a rig in virtual time, each recorded in `folder`, unless its recording exists already.

    Returns the paths of all recordings, rig-NUMBER-EXPERIMENT.mcap with nine digits in NUMBER, in the order of the
    experiments. Raises ConfigError for a rig that cannot run, OutputError for a file that cannot be written,
    RtloopError for a run that cannot start; recordings of earlier experiments stay.
    """
    return record_values(runner, runner.sample_values(rig), f"rig-{rig:09d}", folder)


def record_values(runner: CaseRunner, values: Mapping[str, object], name: str, folder: Path) -> list[Path]:
    """Record a rig with `values` by key, as `record_rig` does, to NAME-EXPERIMENT.mcap for each experiment.

    Keys that `values` lacks have their configured values.
    """
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return [
        _record(runner, values, experiment, folder / f"{name}-{experiment.label}.mcap")
        for experiment in runner.options.experiment
    ]


def _record(runner: CaseRunner, values: Mapping[str, object], experiment: Experiment, path: Path) -> Path:
    """Run and record one experiment of a rig to `path`, unless a recording with ticks exists there; return the path."""
    if path.exists():
        if has_ticks(path):
            return path
        path.unlink()
    source = f"{runner.campaign.name}, {path.stem}"
    text = runner.configuration_text(values, experiment, source)
    configuration = parse(text, path.stem, runner.campaign.folder, source)
    prepared = prepare(configuration, duration_s=experiment.ticks(runner.rate_hz) / runner.rate_hz, paced=False)
    with Processes() as processes:
        Supervisor(processes, prepared, path).run()
    return path


def has_ticks(path: Path) -> bool:
    """Whether a file is a recording with at least one tick; False for a file that cannot be read."""
    try:
        with Reader(path) as reader:
            return bool(reader.tick_chunks)
    except RecordingError:
        return False
