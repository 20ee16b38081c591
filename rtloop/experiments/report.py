"""Report of recordings: every experiment found in them, analysed from these alone.

Recordings of a configuration to compare with add a column, and their curves to pictures that show both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.palette import draw_pictures
from rtloop.experiments.procedure import Experiment
from rtloop.experiments.recorded_run import RecordedRun
from rtloop.experiments.registry import EXPERIMENTS
from rtloop.experiments.verdict import Analysis
from rtloop.recording.errors import RecordingError
from rtloop.recording.load import load
from rtloop.values import to_jsonable

ProgressCallback = Callable[[str], None]


class Report(NamedTuple):
    """Values for JSON, and bytes of PNG pictures by experiment and theme.

    Keys of `content`: name (of the configuration), beside (name of the second one, or None), created_unix_ns, driver
    (its kind), rate_hz, paced, host, realtime, versions, and experiments, a list with a section for each.
    """

    content: dict[str, Any]
    pictures: dict[str, dict[str, bytes]]

    @property
    def is_complete(self) -> bool:
        """Whether every experiment was analysed and drawn: no section has a `problem`."""
        return all(section["problem"] is None for section in self.content["experiments"])


def load_runs(paths: Sequence[Path]) -> list[RecordedRun]:
    """Load the runs that these files hold, in the order of their start; rotated files are one run.

    Raises RecordingError for an unreadable file, and for a recording without a valid description of an experiment.
    """
    run_paths: dict[tuple[int, str | None], list[Path]] = {}
    for path in paths:
        header = load(path).header
        run_paths.setdefault((header["created_unix_ns"], header.get("name")), []).append(path)
    return [RecordedRun(load(files)) for _, files in sorted(run_paths.items(), key=lambda item: item[0][0])]


def make_report(runs: Sequence[RecordedRun], on_progress: ProgressCallback = lambda _: None) -> Report:
    """Return the report of all experiments found in `runs`, one or more; `on_progress` receives a line for each.

    Runs of a second configuration (`--beside`) add a column and curves; an experiment that only the second
    configuration did is left out. If all runs are of the second configuration, it takes the place of the first. An
    experiment that cannot be analysed or drawn has a `problem` and no pictures. Raises RecordingError if two recordings
    are of the same run, MissingExtra without matplotlib.
    """
    sections, pictures_by_name = [], {}
    _require_distinct(runs)
    main_runs = [run for run in runs if not run.is_comparison] or runs
    comparison_runs = [run for run in runs if run not in main_runs]
    for name, experiment in EXPERIMENTS.items():
        experiment_runs, other_runs = (
            [run for run in group if run.experiment == name] for group in (main_runs, comparison_runs)
        )
        if experiment_runs:
            on_progress(f"{name}: analysing")
            section, files = _experiment_section(experiment, experiment_runs, other_runs)
            sections.append(section)
            pictures_by_name[name] = files
    headers = [run.recording.header for run in runs]
    first_header = main_runs[0].recording.header
    content = {
        "name": _configuration_name(main_runs[0]),
        "beside": _configuration_name(comparison_runs[0]) if comparison_runs else None,
        "created_unix_ns": min(header["created_unix_ns"] for header in headers),
        "driver": first_header["driver"]["kind"],
        "rate_hz": first_header["rate_hz"],
        "paced": first_header["paced"],
        "host": first_header["host"],
        "realtime": first_header["realtime"] if first_header["paced"] else None,
        "versions": first_header["versions"],
        "experiments": sections,
    }
    return Report(to_jsonable(content), pictures_by_name)


def _experiment_section(
    experiment: Experiment, runs: Sequence[RecordedRun], comparison_runs: Sequence[RecordedRun]
) -> tuple[dict[str, object], dict[str, bytes]]:
    """Return the section of one experiment for JSON, and its pictures by theme.

    Keys: name, title, about, parameters, middle_um (the middle of the motion), reduced (a text for each default that a
    limit reduced), recordings (file names), periods_missed, problem, rows, tables, notes. The notes begin with one on
    the middle, unless it is 0, and one for each reduced default. The problem is None, or the reason why pictures, and
    possibly rows, are missing. Raises MissingExtra without matplotlib.
    """
    comparison: Analysis | None = None
    analysis: Analysis | None = None
    files: dict[str, bytes] = {}
    problem = None
    try:
        analysis = _analyse(experiment, runs)
        curves = analysis.curves
        if comparison_runs:
            comparison = _analyse(experiment, comparison_runs)
            curves = {**curves, "beside": {**comparison.curves, "name": _configuration_name(comparison_runs[0])}}
        files = draw_pictures(experiment.draw, curves, experiment.size)
    except (UnsuitableData, ValueError) as fault:
        problem = str(fault)
    comparison_values = {row.quantity: row.run for row in comparison.rows} if comparison else {}
    section = {
        "name": experiment.name,
        "title": experiment.title,
        "about": experiment.description,
        "parameters": runs[0].parameters,
        "middle_um": runs[0].middle_um,
        "reduced": runs[0].reductions,
        "recordings": [path.name for run in [*runs, *comparison_runs] for path in run.paths],
        "periods_missed": sum(int(run.recording["periods_missed"][1:].sum()) for run in [*runs, *comparison_runs]),
        "problem": problem,
        "rows": [{**row.as_dict(), "beside": comparison_values.get(row.quantity)} for row in analysis.rows]
        if analysis
        else [],
        "tables": analysis.tables if analysis else (),
        "notes": [
            *_middle_notes(runs[0]),
            *(f"Reduced: {text}." for text in runs[0].reductions),
            *(analysis.notes if analysis else ()),
        ],
    }
    return section, files


def _middle_notes(run: RecordedRun) -> list[str]:
    """Return a list of one note, on the middle of a run's motion; [] for a motion about 0."""
    if not run.middle_um:
        return []
    return [
        f"The drive has only one sign. Therefore the experiment moves about {run.middle_um:g} µm, the middle of the "
        "positions that the drive can reach from every other position. Reference, command and position are "
        "relative to this middle."
    ]


def _analyse(experiment: Experiment, runs: Sequence[RecordedRun]) -> Analysis:
    """Return the analysis of an experiment's runs, all with the parameters of the first one.

    Raises UnsuitableData or ValueError for runs that are incomplete, clipped or cannot be judged, and for missing runs.
    """
    for run in runs:
        run.require_complete()
    if len(runs) < runs[0].run_count:
        raise UnsuitableData(
            f"only {len(runs)} of {runs[0].run_count} recordings of this experiment are given; not analysed. "
            "Give all of them"
        )
    return experiment.analyse(runs, experiment.options.model_validate(runs[0].parameters))


def _configuration_name(run: RecordedRun) -> str:
    """Name of the configuration from which the run was derived, by the name in the recording's header."""
    return run.recording.header["name"].rsplit(f"-{run.experiment}", 1)[0]


def _require_distinct(runs: Sequence[RecordedRun]) -> None:
    """Raise RecordingError if two recordings have the same experiment and run label, and both are of the first
    configuration or both of the second one (`--beside`)."""
    run_by_key: dict[tuple[str, str, bool], RecordedRun] = {}
    for run in runs:
        key = run.experiment, run.label, run.is_comparison
        if key in run_by_key:
            raise RecordingError(
                f"{run.paths[0]}: the run '{run.experiment} {run.label}".rstrip() + "' is also recorded in "
                f"{run_by_key[key].paths[0]}; allowed: one recording of each run"
            )
        run_by_key[key] = run
