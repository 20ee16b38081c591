"""The tables of docs/benchmarks.md, from the newest figures of the history."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tests.benchmarks.targets import Figure, figures, number

BEGIN, END = "<!-- figures: begin -->\n", "<!-- figures: end -->\n"


class NoPlace(ValueError):
    """A page without the two markers."""


def rewrite(path: Path, entries: Mapping[str, dict[str, Any]], benchmarks: Mapping[str, Callable[..., Any]]) -> None:
    """Put the tables between the markers of a page, and leave the rest of it. Raises NoPlace, OSError."""
    text = path.read_text(encoding="utf-8")
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
        raise NoPlace(f"{path}: {BEGIN.strip()} and {END.strip()} must be there, once, in this order")
    before, rest = text.split(BEGIN)
    sections = [_section(name, inspect.getdoc(run) or "", entries.get(name)) for name, run in benchmarks.items()]
    path.write_text(before + BEGIN + "\n" + "\n".join(sections) + "\n" + END + rest.split(END)[1], encoding="utf-8")


def _section(name: str, method: str, entry: Mapping[str, Any] | None) -> str:
    """Heading, method, table, and where the figures come from."""
    lines = [f"### {name}", "", method, ""]
    if entry is None:
        return "\n".join([*lines, "Not measured yet.", ""])
    lines += ["| figure | median | smallest … largest | target |", "|---|---:|---|---|"]
    lines += [_row(figure) for figure in figures(name, entry["results"])]
    repeated = f"{entry['pairs']} repetitions" + ("" if entry["share"] == 1 else ", shortened")
    lines += ["", f"{entry['date'][:10]}, revision {entry['revision']}, {repeated}, load {entry['load']:g}.", ""]
    return "\n".join(lines)


def _row(figure: Figure) -> str:
    if isinstance(figure.value, str):
        return f"| {figure.name} | – | {figure.value} | |"
    span = "" if figure.low is None or figure.high is None else f"{number(figure.low)} … {number(figure.high)}"
    return f"| {figure.name} | {number(figure.value)} | {span} | {figure.verdict} |"
