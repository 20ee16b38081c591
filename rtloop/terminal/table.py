"""What the reports share: a console that does not wrap paths, a table without lines."""

from __future__ import annotations

import math

from rich.console import Console
from rich.table import Table

WIDEST = 10_000


def console() -> Console:
    """Standard output, unhighlighted; long lines are left to the terminal, and no number is cut to fit it."""
    return Console(highlight=False, soft_wrap=True, width=WIDEST)


def figure(value: float, digits: int, unit: str = "") -> str:
    """A number with so many digits behind the point and its unit; "–" for one that is infinite or does not exist."""
    return f"{value:.{digits}f}{unit}" if math.isfinite(value) else "–"


def table(*headings: str) -> Table:
    """A table without lines: labels to the left, numbers to the right; words alone where nothing is headed."""
    empty = Table(*headings, box=None, show_header=any(headings), pad_edge=False, padding=(0, 3, 0, 0))
    for column in empty.columns[1:]:
        column.justify = "right" if any(headings) else "left"
    return empty
