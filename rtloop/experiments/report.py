"""From recordings to a report: every experiment that is found in them, analysed anew from nothing else.

Recordings of a configuration that stands beside give a column more, and their curves to pictures that show both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rtloop.design.identification.measured import UnsuitableData
from rtloop.experiments.procedure import Experiment
from rtloop.experiments.registry import EXPERIMENTS
from rtloop.experiments.taken import Taken
from rtloop.experiments.theme import pictures
from rtloop.experiments.verdict import Analysis, Table
from rtloop.recording.errors import RecordingError
from rtloop.recording.load import load
from rtloop.values import to_jsonable

Say = Callable[[str], None]


class Report(NamedTuple):
    """Plain values for JSON, and PNG files by experiment and theme."""

    content: dict[str, Any]
    pictures: dict[str, dict[str, bytes]]

    @property
    def whole(self) -> bool:
        """Every experiment could be analysed."""
        return all(section["problem"] is None for section in self.content["experiments"])


def take(paths: Sequence[Path]) -> list[Taken]:
    """The runs that these files hold, in their order, rotated ones put together. Raises RecordingError."""
    run_paths: dict[tuple[Any, ...], list[Path]] = {}
    for path in paths:
        header = load(path).header
        run_paths.setdefault((header["created_unix_ns"], header.get("name")), []).append(path)
    return [Taken(load(files)) for _, files in sorted(run_paths.items(), key=lambda item: item[0][0])]


def report(takings: Sequence[Taken], say: Say = lambda _: None) -> Report:
    """Analyse what there is, in their order. Raises RecordingError where two recordings are of the same run."""
    sections, pictures_by_name = [], {}
    _require_distinct(takings)
    main_runs = [run for run in takings if not run.beside] or takings
    comparison_runs = [run for run in takings if run not in main_runs]
    for name, experiment in EXPERIMENTS.items():
        experiment_runs, other_runs = ([run for run in group if run.experiment == name] for group in (main_runs, comparison_runs))
        if experiment_runs:
            say(f"{name}: analysing")
            section, files = _section(experiment, experiment_runs, other_runs)
            sections.append(section)
            pictures_by_name[name] = files
    headers = [run.recording.header for run in takings]
    first_header = main_runs[0].recording.header
    content = {
        "name": _name(main_runs[0]),
        "beside": _name(comparison_runs[0]) if comparison_runs else None,
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


def _section(
    experiment: Experiment, takings: Sequence[Taken], others: Sequence[Taken]
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """One experiment: verdicts and pictures, or the problem that prevents them."""
    comparison: Analysis | None = None
    analysis: Analysis | None = None
    files: dict[str, bytes] = {}
    problem = None
    try:
        analysis = _analysed(experiment, takings)
        curves = analysis.curves
        if others:
            comparison = _analysed(experiment, others)
            curves = {**curves, "beside": {**comparison.curves, "name": _name(others[0])}}
        files = pictures(experiment.draw, curves, experiment.size)
    except (UnsuitableData, ValueError) as fault:
        problem = str(fault)
    comparison_values = {row.quantity: row.run for row in comparison.rows} if comparison else {}
    section = {
        "name": experiment.name,
        "title": experiment.title,
        "about": experiment.about,
        "parameters": takings[0].parameters,
        "recordings": [path.name for run in [*takings, *others] for path in run.paths],
        "periods_missed": sum(int(run.recording["periods_missed"][1:].sum()) for run in [*takings, *others]),
        "problem": problem,
        "rows": [{**row.as_dict(), "beside": comparison_values.get(row.quantity)} for row in analysis.rows] if analysis else [],
        "tables": [_table(table) for table in analysis.tables] if analysis else [],
        "notes": list(analysis.notes) if analysis else [],
    }
    return section, files


def _analysed(experiment: Experiment, takings: Sequence[Taken]) -> Analysis:
    """Raises UnsuitableData or ValueError for what cannot be judged."""
    for run in takings:
        run.require_whole()
    if len(takings) < takings[0].runs:
        raise UnsuitableData(f"{len(takings)} of its {takings[0].runs} recordings are there; not analysed")
    return experiment.analyse(takings, experiment.options.model_validate(takings[0].parameters))


def _name(taken: Taken) -> str:
    """Of the configuration that the run was derived from."""
    return taken.recording.header["name"].rsplit(f"-{taken.experiment}", 1)[0]


def _table(table: Table) -> dict[str, Any]:
    return {"title": table.title, "headings": list(table.headings), "rows": [list(row) for row in table.rows]}


def _require_distinct(takings: Sequence[Taken]) -> None:
    run_by_key: dict[tuple[str, str, bool], Taken] = {}
    for run in takings:
        key = run.experiment, run.label, run.beside
        if key in run_by_key:
            raise RecordingError(f"{run.paths[0]}: {run.experiment} {run.label}".rstrip() + " is in "
                                 f"{run_by_key[key].paths[0]} as well; one of them is needed")  # fmt: skip
        run_by_key[key] = run
