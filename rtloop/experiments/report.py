"""From recordings to a report: every experiment that is found in them, analysed anew from nothing else."""

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
from rtloop.values import plain

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
    for name, experiment in EXPERIMENTS.items():
        mine = [taken for taken in takings if taken.experiment == name]
        if mine:
            say(f"{name}: analysing")
            section, files = _section(experiment, mine)
            sections.append(section)
            drawn[name] = files
    headers = [taken.recording.header for taken in takings]
    first = headers[0]
    content = {
        "name": first["name"].removesuffix(f"-{takings[0].experiment}"),
        "created_unix_ns": min(header["created_unix_ns"] for header in headers),
        "driver": first["driver"]["kind"],
        "rate_hz": first["rate_hz"],
        "paced": first["paced"],
        "host": first["host"],
        "realtime": first["realtime"] if first["paced"] else None,
        "versions": first["versions"],
        "experiments": sections,
    }
    return Report(plain(content), drawn)


def _section(experiment: Experiment, takings: Sequence[Taken]) -> tuple[dict[str, Any], dict[str, bytes]]:
    """One experiment: verdicts and pictures, or the problem that prevents them."""
    found: Analysis | None = None
    files: dict[str, bytes] = {}
    problem = None
    try:
        for taken in takings:
            taken.require_whole()
        if len(takings) < takings[0].runs:
            raise UnsuitableData(f"{len(takings)} of its {takings[0].runs} recordings are there; not analysed")
        options = experiment.options.model_validate(takings[0].parameters)
        found = experiment.analyse(takings, options)
        files = pictures(experiment.draw, found.curves, experiment.size)
    except (UnsuitableData, ValueError) as fault:
        problem = str(fault)
    section = {
        "name": experiment.name,
        "title": experiment.title,
        "about": experiment.about,
        "parameters": takings[0].parameters,
        "recordings": [path.name for taken in takings for path in taken.paths],
        "periods_missed": sum(int(taken.recording["periods_missed"][1:].sum()) for taken in takings),
        "problem": problem,
        "rows": [row.as_dict() for row in found.rows] if found else [],
        "tables": [_table(table) for table in found.tables] if found else [],
        "notes": list(found.notes) if found else [],
    }
    return section, files


def _table(table: Table) -> dict[str, Any]:
    return {"title": table.title, "headings": list(table.headings), "rows": [list(row) for row in table.rows]}


def _require_distinct(takings: Sequence[Taken]) -> None:
    seen: dict[tuple[str, str], Taken] = {}
    for taken in takings:
        key = taken.experiment, taken.label
        if key in seen:
            raise RecordingError(f"{taken.paths[0]}: {taken.experiment} {taken.label}".rstrip() + " is in "
                                 f"{seen[key].paths[0]} as well; one of them is needed")  # fmt: skip
        seen[key] = taken
