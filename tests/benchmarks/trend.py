"""The trend: ratios of every full run, with commit and machine, in docs/benchmarks/history.csv, and their picture."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from tests.benchmarks.configurations import ROOT
from tests.benchmarks.targets import TARGETS, Figure, figures, number

TABLE = ROOT / "docs" / "benchmarks" / "history.csv"
PICTURE = TABLE.with_suffix(".svg")
MIN_CHANGE = 0.1
"""Smallest worsening that is reported, as a share of the last median."""


class TrendRow(NamedTuple):
    """A ratio of one run: median, smallest and largest of its repetitions."""

    date: str
    revision: str
    machine: str
    figure: str
    median: float
    smallest: float
    largest: float


def ratios(entry: Mapping[str, Any]) -> list[TrendRow]:
    """Return the ratios and the times real time in an entry of the history; times and sizes are left out.

    Times and sizes depend on the machine; a ratio compares two programs on the same machine.
    """
    machine = f"{entry['host']['cpu']}, {entry['host']['cpus']} processors"
    return [
        TrendRow(entry["date"], entry["revision"], machine, f"{entry['benchmark']} {figure.name}",
                 figure.value, figure.low or figure.value, figure.high or figure.value)
        for figure in figures(entry["benchmark"], entry["results"])
        if _is_ratio(figure) and not isinstance(figure.value, str)
    ]  # fmt: skip


def read(path: Path = TABLE) -> list[TrendRow]:
    """Return the rows of the table, oldest first; [] without the file."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [
            TrendRow(row["date"], row["revision"], row["machine"], row["figure"],
                     float(row["median"]), float(row["smallest"]), float(row["largest"]))
            for row in csv.DictReader(file)
        ]  # fmt: skip


def append(rows: Iterable[TrendRow], path: Path = TABLE) -> None:
    """Add rows to the table, four digits each, and make the file if there is none."""
    is_new = not path.exists()
    path.parent.mkdir(exist_ok=True)
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        if is_new:
            writer.writerow(TrendRow._fields)
        writer.writerows([*row[:4], *(f"{value:.4g}" for value in row[4:])] for row in rows)


def setbacks(before: Sequence[TrendRow], current: Sequence[TrendRow]) -> list[str]:
    """Return a sentence for each ratio in `current` that is worse than its last value in `before`.

    A ratio is worse if it changed by more than MIN_CHANGE of the last median, and by more than its repetitions' spread.
    """
    last = {row.figure: row for row in before}
    return [
        f"{row.figure}: {number(row.median)} ({number(row.smallest)} … {number(row.largest)}), "
        f"{number(last[row.figure].median)} at revision {last[row.figure].revision}"
        for row in current
        if row.figure in last and _worsening(last[row.figure], row) > max(
            MIN_CHANGE * last[row.figure].median, row.largest - row.smallest
        )
    ]  # fmt: skip


def draw(rows: Sequence[TrendRow], path: Path = PICTURE) -> None:
    """Draw every ratio over its runs, in order, with its spread and its target, as SVG."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure as Picture

    by_figure = {name: list(group) for name, group in groupby(sorted(rows, key=_figure_name), key=_figure_name)}
    picture = Picture(figsize=(12.0, 1.9 * -(-len(by_figure) // 3)), layout="constrained")
    FigureCanvasSVG(picture)
    panels = picture.subplots(-(-len(by_figure) // 3), 3, squeeze=False).flat
    for panel, (name, runs) in zip(panels, by_figure.items(), strict=False):
        runs.sort(key=lambda row: row.date)
        spread = [[row.median - row.smallest for row in runs], [row.largest - row.median for row in runs]]
        panel.errorbar(range(len(runs)), [row.median for row in runs], spread, marker="o", capsize=2)
        if name in TARGETS:
            panel.axhline(TARGETS[name].value, linestyle="--", color="grey")
        panel.set_title(name, fontsize=8)
        panel.set_xticks(range(len(runs)), [row.revision[:7] for row in runs], rotation=30, fontsize=6)
        panel.margins(y=0.15)
        panel.set_ylim(bottom=0.0)
    for panel in list(picture.axes)[len(by_figure) :]:
        panel.remove()
    path.parent.mkdir(exist_ok=True)
    picture.savefig(path, metadata={"Date": None})


def _figure_name(row: TrendRow) -> str:
    """Return the figure of a row, as the key of a sort."""
    return row.figure


def _is_ratio(figure: Figure) -> bool:
    """Whether a figure compares two programs, or the simulated time with the real one."""
    last = figure.name.split()[-1]
    return last.endswith("ratio") or last.startswith(("times_", "scaling"))


def _worsening(before: TrendRow, current: TrendRow) -> float:
    """Return the worsening of a median: its increase for a ratio of costs, its decrease for a speed."""
    is_cost = before.figure.endswith("ratio")
    return current.median - before.median if is_cost else before.median - current.median
