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
    """Return a console on standard output, without highlighting. The terminal wraps long lines; no number is cut."""
    from rich.console import Console

    return Console(highlight=False, soft_wrap=True, width=MAX_WIDTH)


def table(*headings: str, rows: Iterable[Sequence[str]] = (), words: Sequence[int] = ()) -> Table:
    """Return a table without lines: the first column and the columns `words` to the left, the others to the right.

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
    """Return `text` as a string whose brackets rich does not read as markup."""
    from rich.markup import escape as escape_markup

    return escape_markup(str(text))


def format_figure(value: float, digits: int, unit: str = "") -> str:
    """Return a number with `digits` decimals and its unit as text; "–" where it is infinite or NaN."""
    return f"{value:.{digits}f}{unit}" if math.isfinite(value) else "–"


def format_number(value: float | None, form: str = ".4g") -> str:
    """Return a number in the format `form` as text; "–" for None."""
    return "–" if value is None else f"{value:{form}}"


def print_problems(out: Console, problems: Iterable[str]) -> None:
    """Print the problems of a recording, one a line."""
    for problem in problems:
        out.print(f"[red]problem[/]: {escape(problem)}")
