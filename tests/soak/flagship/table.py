"""Rows of the comparison: what is asked, what each loop does, and whether ours keeps it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

HEADINGS = ("", "goal", "paper", "ours", "met")


class Row(NamedTuple):
    """A quantity; without a goal it is said and not judged. Infinite stands for a loop that is unstable or trips,
    nan for a search that found none."""

    name: str
    unit: str
    goal: float | None
    paper: float | None
    ours: float
    at_least: bool = False
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Whether ours keeps the goal, to the digits that it is given with; None without one."""
        if self.goal is None:
            return None
        return self.ours >= self.goal if self.at_least else self.ours <= self.goal

    @property
    def cells(self) -> tuple[str, ...]:
        """For people."""
        sign = "≥" if self.at_least else "≤"
        goal = "–" if self.goal is None else f"{sign} {self.goal:g} {self.unit}"
        met = {None: "", True: "yes", False: "NO"}[self.met]
        return self.name, goal, _said(self.paper, self.unit), _said(self.ours, self.unit), met

    def as_dict(self) -> dict[str, Any]:
        """For JSON, which has no infinity."""
        values = {name: value if value is None or math.isfinite(value) else str(value)
                  for name, value in (("goal", self.goal), ("paper", self.paper), ("ours", self.ours))}  # fmt: skip
        return {"name": self.name, "unit": self.unit, **values, "at_least": self.at_least, "met": self.met,
                "note": self.note}  # fmt: skip


def _said(value: float | None, unit: str) -> str:
    if value is None:
        return "–"
    if math.isnan(value):
        return "none found"
    return f"{value:.3g} {unit}".strip() if math.isfinite(value) else "unstable"


def text(rows: Sequence[Row]) -> str:
    """All of them, in columns, and what is noted of them."""
    cells = [HEADINGS, *(row.cells for row in rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(HEADINGS))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]
    judged = [row for row in rows if row.met is not None]
    missed = [row.name for row in judged if not row.met]
    notes = [f"{row.name}: {row.note}" for row in rows if row.note]
    kept = f"{len(judged) - len(missed)} of {len(judged)} goals are met"
    return "\n".join([*lines, "", *notes, f"{kept}; missed: {', '.join(missed)}" if missed else kept])
