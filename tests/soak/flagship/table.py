"""Rows of the comparison: the goal, the figure of each loop, and whether rtloop's own loop meets the goal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

HEADINGS = ("", "goal", "paper", "ours", "met")


class Row(NamedTuple):
    """A quantity; without a goal it is printed and not judged. Infinity stands for a loop that is unstable or trips,
    nan for a search that found no controller."""

    name: str
    unit: str
    goal: float | None
    paper: float | None
    ours: float
    at_least: bool = False
    note: str = ""

    @property
    def is_met(self) -> bool | None:
        """Whether rtloop's own loop meets the goal; None without a goal."""
        if self.goal is None:
            return None
        return self.ours >= self.goal if self.at_least else self.ours <= self.goal

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells of the printed table."""
        sign = "≥" if self.at_least else "≤"
        goal = "–" if self.goal is None else f"{sign} {self.goal:g} {self.unit}"
        met = {None: "", True: "yes", False: "NO"}[self.is_met]
        return self.name, goal, _format_value(self.paper, self.unit), _format_value(self.ours, self.unit), met

    def as_dict(self) -> dict[str, Any]:
        """Return the row for JSON, which has no infinity: such values become text."""
        values = {name: value if value is None or math.isfinite(value) else str(value)
                  for name, value in (("goal", self.goal), ("paper", self.paper), ("ours", self.ours))}  # fmt: skip
        return {"name": self.name, "unit": self.unit, **values, "at_least": self.at_least, "met": self.is_met,
                "note": self.note}  # fmt: skip


def _format_value(value: float | None, unit: str) -> str:
    """Return a value with three digits and its unit, or a word for None, nan and infinity."""
    if value is None:
        return "–"
    if math.isnan(value):
        return "none found"
    return f"{value:.3g} {unit}".strip() if math.isfinite(value) else "unstable"


def format_table(rows: Sequence[Row]) -> str:
    """Return the rows as text in columns, their notes, and the count of goals that are met."""
    cells = [HEADINGS, *(row.cells for row in rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(HEADINGS))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]
    rows_with_goal = [row for row in rows if row.is_met is not None]
    missed = [row.name for row in rows_with_goal if not row.is_met]
    notes = [f"{row.name}: {row.note}" for row in rows if row.note]
    summary = f"{len(rows_with_goal) - len(missed)} of {len(rows_with_goal)} goals are met"
    return "\n".join([*lines, "", *notes, f"{summary}; missed: {', '.join(missed)}" if missed else summary])
