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
    parts: dict[tuple[Any, ...], list[Path]] = {}
    for path in paths:
        header = load(path).header
        parts.setdefault((header["created_unix_ns"], header.get("name")), []).append(path)
    return [Taken(load(files)) for _, files in sorted(parts.items(), key=lambda item: item[0][0])]


def report(takings: Sequence[Taken], say: Say = lambda _: None) -> Report:
    """Analyse what there is, in their order. Raises RecordingError where two recordings are of the same run."""
    sections, drawn = [], {}
    _require_distinct(takings)
    own = [taken for taken in takings if not taken.beside] or takings
    others = [taken for taken in takings if taken not in own]
    for name, experiment in EXPERIMENTS.items():
        mine, other = ([taken for taken in some if taken.experiment == name] for some in (own, others))
        if mine:
            say(f"{name}: analysing")
            section, files = _section(experiment, mine, other)
            sections.append(section)
            drawn[name] = files
    headers = [taken.recording.header for taken in takings]
    first = own[0].recording.header
    content = {
        "name": _name(own[0]),
        "beside": _name(others[0]) if others else None,
        "created_unix_ns": min(header["created_unix_ns"] for header in headers),
        "driver": first["driver"]["kind"],
        "rate_hz": first["rate_hz"],
        "paced": first["paced"],
        "host": first["host"],
        "realtime": first["realtime"] if first["paced"] else None,
        "versions": first["versions"],
        "experiments": sections,
    }
    return Report(to_jsonable(content), drawn)


def _section(
    experiment: Experiment, takings: Sequence[Taken], others: Sequence[Taken]
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """One experiment: verdicts and pictures, or the problem that prevents them."""
    beside: Analysis | None = None
    found: Analysis | None = None
    files: dict[str, bytes] = {}
    problem = None
    try:
        found = _analysed(experiment, takings)
        curves = found.curves
        if others:
            beside = _analysed(experiment, others)
            curves = {**curves, "beside": {**beside.curves, "name": _name(others[0])}}
        files = pictures(experiment.draw, curves, experiment.size)
    except (UnsuitableData, ValueError) as fault:
        problem = str(fault)
    second = {row.quantity: row.run for row in beside.rows} if beside else {}
    section = {
        "name": experiment.name,
        "title": experiment.title,
        "about": experiment.about,
        "parameters": takings[0].parameters,
        "recordings": [path.name for taken in [*takings, *others] for path in taken.paths],
        "periods_missed": sum(int(taken.recording["periods_missed"][1:].sum()) for taken in [*takings, *others]),
        "problem": problem,
        "rows": [{**row.as_dict(), "beside": second.get(row.quantity)} for row in found.rows] if found else [],
        "tables": [_table(table) for table in found.tables] if found else [],
        "notes": list(found.notes) if found else [],
    }
    return section, files


def _analysed(experiment: Experiment, takings: Sequence[Taken]) -> Analysis:
    """Raises UnsuitableData or ValueError for what cannot be judged."""
    for taken in takings:
        taken.require_whole()
    if len(takings) < takings[0].runs:
        raise UnsuitableData(f"{len(takings)} of its {takings[0].runs} recordings are there; not analysed")
    return experiment.analyse(takings, experiment.options.model_validate(takings[0].parameters))


def _name(taken: Taken) -> str:
    """Of the configuration that the run was derived from."""
    return taken.recording.header["name"].rsplit(f"-{taken.experiment}", 1)[0]


def _table(table: Table) -> dict[str, Any]:
    return {"title": table.title, "headings": list(table.headings), "rows": [list(row) for row in table.rows]}


def _require_distinct(takings: Sequence[Taken]) -> None:
    seen: dict[tuple[str, str, bool], Taken] = {}
    for taken in takings:
        key = taken.experiment, taken.label, taken.beside
        if key in seen:
            raise RecordingError(f"{taken.paths[0]}: {taken.experiment} {taken.label}".rstrip() + " is in "
                                 f"{seen[key].paths[0]} as well; one of them is needed")  # fmt: skip
        seen[key] = taken
