"""Recordings of single rigs: the same loop with the recorder beside it, for a rig that is worth a look."""

from __future__ import annotations

from pathlib import Path

from rtloop.campaigns.case import CaseRunner
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.errors import output_errors
from rtloop.supervision.supervisor import Processes, Supervisor


def record_rig(runner: CaseRunner, rig: int, folder: Path) -> list[Path]:
    """Run all experiments of a rig in virtual time, each recorded in `folder`; a recording that exists is kept.

    Returns the paths of the recordings. Raises ConfigError for a rig that cannot run, OutputError.
    """
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return [_record(runner, rig, number, folder) for number in range(len(runner.options.experiment))]


def _record(runner: CaseRunner, rig: int, number: int, folder: Path) -> Path:
    """Record experiment `number` of a rig; return the path of the recording."""
    experiment = runner.options.experiment[number]
    name = f"rig-{rig:09d}-{experiment.label}"
    path = folder / f"{name}.mcap"
    if path.exists():
        return path
    text = runner.configuration_text(rig, experiment)
    configuration = parse(text, name, runner.campaign.folder, f"{runner.campaign.name}, {name}")
    prepared = prepare(configuration, duration_s=experiment.duration_s, paced=False)
    with Processes() as processes:
        Supervisor(processes, prepared, path).run()
    return path
