"""What the terminal shows of experiments: the list, progress with the time left, verdicts."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import IO, Any

from rich.markup import escape

from rtloop.experiments.page import HEADINGS, comparison_cell, comparison_keys, format_number, second_value_cell
from rtloop.experiments.registry import EXPERIMENTS
from rtloop.terminal.progress import StatusLine
from rtloop.terminal.table import console, table

COLOURS = {"good": "green", "mixed": "yellow", "bad": "red", "": "default"}


class Progress(StatusLine):
    """Which run of how many, how far, and about how long all of them still take."""

    def __init__(self, total_ticks: int, stream: IO[str]) -> None:
        super().__init__("starting", stream)
        self._total, self._done = total_ticks, 0
        self._began_s = time.monotonic()

    def show(self, label: str, ticks: int, planned: int) -> None:
        """Ticks of the present run."""
        done = self._done + min(ticks, planned)
        spent_s = time.monotonic() - self._began_s
        left = f"about {duration(spent_s * (self._total - done) / done)} left" if done else ""
        self.update(f"{label}: {100 * min(ticks, planned) // planned} %   all: {100 * done // self._total} %   {left}")

    def more(self, ticks: int) -> None:
        """A run follows that nobody knew of before."""
        self._total += ticks

    def finished(self, planned: int) -> None:
        """A run has ended."""
        self._done += planned


def duration(seconds: float) -> str:
    """In words that can be read at a glance."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def print_list() -> None:
    """Every experiment with its parameters."""
    shown = console()
    for experiment in EXPERIMENTS.values():
        shown.print(f"[bold]{experiment.name}[/]  {experiment.title}")
        shown.print(f"  {experiment.description}")
        for name, field in experiment.options.model_fields.items():
            value = list(field.default) if isinstance(field.default, tuple) else field.default
            text = "…  (follows the axis)" if value is None else value
            shown.print(f"  --set {experiment.name}.{name}={text}", style="dim", markup=False)


def print_report(content: Mapping[str, Any], skipped: Mapping[str, str]) -> None:
    """Verdicts of every experiment; lines that are too long are left to the terminal."""
    shown = console()
    for section in content["experiments"]:
        shown.print(f"[bold]{section['title']}[/]")
        if section["problem"]:
            shown.print(f"  [red]{escape(section['problem'])}[/]")
            continue
        keys = comparison_keys(section["rows"])
        second = [f"{content['beside']} gave"] if content["beside"] else []
        rows = table("", *(HEADINGS[key] for key in keys), "this run gave", *second, "verdict")
        rows.columns[-1].justify = "left"
        for row in section["rows"]:
            unit = "" if row["unit"] == "1" else f" {row['unit']}"
            run = "–" if row["run"] is None else format_number(row["run"]) + unit
            beside = (escape(comparison_cell(row, key)) for key in keys)
            verdict = f"[{COLOURS[row['mark']]}]{escape(row['verdict'])}[/]"
            rows.add_row(f"  {row['quantity']}", *beside, run, *([second_value_cell(row)] if second else []), verdict)
        shown.print(rows)
    for name, reason in skipped.items():
        shown.print(f"[bold]{name}[/] skipped: {escape(reason)}")
