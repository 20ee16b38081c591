"""Tables without lines on a console that does not wrap paths."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

MAX_WIDTH = 10_000


def console() -> Console:
    """Make a console on standard output, without highlighting. The terminal wraps long lines; no number is cut."""
    from rich.console import Console

    return Console(highlight=False, soft_wrap=True, width=MAX_WIDTH)


def table(*headings: str, rows: Iterable[Sequence[str]] = (), words: Sequence[int] = ()) -> Table:
    """Make a table without lines: the first column to the left, the others to the right, but for the columns `words`.

    With empty headings alone, every column is to the left and no heading is printed.
    """
    from rich.table import Table

    lines = Table(*headings, box=None, show_header=any(headings), pad_edge=False, padding=(0, 3, 0, 0))
    for number, column in enumerate(lines.columns):
        column.justify = "right" if any(headings) and number and number not in words else "left"
    for row in rows:
        lines.add_row(*row)
    return lines


def escape(text: object) -> str:
    """Escape brackets, which rich would read as markup."""
    from rich.markup import escape as escape_markup

    return escape_markup(str(text))


def format_figure(value: float, digits: int, unit: str = "") -> str:
    """Format a number with `digits` decimals and its unit; "–" where it is infinite or NaN."""
    return f"{value:.{digits}f}{unit}" if math.isfinite(value) else "–"


def format_number(value: float | None, form: str = ".4g") -> str:
    """Format a number as `form` says; "–" for None."""
    return "–" if value is None else f"{value:{form}}"


def print_problems(out: Console, problems: Iterable[str]) -> None:
    """Print the problems of a recording, one a line."""
    for problem in problems:
        out.print(f"[red]problem[/]: {escape(problem)}")
