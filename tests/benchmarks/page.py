"""Update of the tables in docs/benchmarks.md with the newest figures of the history."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tests.benchmarks.targets import Figure, figures, number

BEGIN, END = "<!-- figures: begin -->\n", "<!-- figures: end -->\n"


class MissingMarkers(ValueError):
    """A page does not contain each of the two markers once, in order."""


def rewrite(path: Path, entries: Mapping[str, dict[str, Any]], benchmarks: Mapping[str, Callable[..., Any]]) -> None:
    """Replace the text between the markers of a page by the tables. Raises MissingMarkers, OSError."""
    text = path.read_text(encoding="utf-8")
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
        raise MissingMarkers(f"{path}: {BEGIN.strip()} and {END.strip()} must each occur once, in this order")
    before, after = text.split(BEGIN)
    sections = [_section(name, inspect.getdoc(run) or "", entries.get(name)) for name, run in benchmarks.items()]
    path.write_text(before + BEGIN + "\n" + "\n".join(sections) + "\n" + END + after.split(END)[1], encoding="utf-8")


def _section(name: str, method: str, entry: Mapping[str, Any] | None) -> str:
    """Return a benchmark's section: heading, method, table, date and revision of the figures."""
    lines = [f"### {name}", "", method, ""]
    if entry is None:
        return "\n".join([*lines, "Not measured yet.", ""])
    lines += ["| figure | median | smallest … largest | target |", "|---|---:|---|---|"]
    lines += [_row(figure) for figure in figures(name, entry["results"])]
    repeated = f"{entry['pairs']} repetitions" + ("" if entry["share"] == 1 else ", shortened")
    lines += ["", f"{entry['date'][:10]}, revision {entry['revision']}, {repeated}, load {entry['load']:g}.", ""]
    return "\n".join(lines)


def _row(figure: Figure) -> str:
    """Return the table's row of a figure."""
    if isinstance(figure.value, str):
        return f"| {figure.name} | – | {figure.value} | |"
    span = "" if figure.low is None or figure.high is None else f"{number(figure.low)} … {number(figure.high)}"
    return f"| {figure.name} | {number(figure.value)} | {span} | {figure.verdict} |"
