"""Tables without lines on a console that does not wrap paths: on the terminal, as a string or as HTML."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

MAX_WIDTH = 10_000
HTML = '<pre style="font-family:monospace;line-height:1.3;overflow-x:auto">{code}</pre>'


def console() -> Console:
    """Return a console on standard output, without highlighting. The terminal wraps long lines; no number is cut."""
    from rich.console import Console

    return Console(highlight=False, soft_wrap=True, width=MAX_WIDTH)


def _recording_console() -> Console:
    """Return a console that stores its output, and shows none in a notebook or on a terminal."""
    from rich.console import Console

    options = {"highlight": False, "soft_wrap": True, "width": MAX_WIDTH, "force_jupyter": False}
    return Console(file=io.StringIO(), record=True, **options)


def render_text(print_text: Callable[[Console], None]) -> str:
    """Return the output of `print_text` as a string without colours; lines have no trailing spaces."""
    out = _recording_console()
    print_text(out)
    return "\n".join(line.rstrip() for line in out.export_text().splitlines())


def render_html(print_text: Callable[[Console], None]) -> str:
    """Return the output of `print_text` as HTML with its colours."""
    out = _recording_console()
    print_text(out)
    return out.export_html(inline_styles=True, code_format=HTML)


def table(*headings: str, rows: Iterable[Sequence[str]] = (), words: Sequence[int] = ()) -> Table:
    """Return a table without lines: the first column and the columns `words` to the left, the others to the right.

    `words` are numbers of columns, from 0. With empty headings alone, every column is to the left and no heading is
    printed.
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
    """Return a number with `digits` decimals and its unit as text; "–" without a unit where it is infinite or NaN."""
    return f"{value:.{digits}f}{unit}" if math.isfinite(value) else "–"


def format_number(value: float | None, form: str = ".4g") -> str:
    """Return a number in the format `form` as text; "–" for None, "nan" for NaN."""
    return "–" if value is None else f"{value:{form}}"


def print_problems(out: Console, problems: Iterable[str]) -> None:
    """Print the problems of a recording, one a line."""
    for problem in problems:
        out.print(f"[red]problem[/]: {escape(problem)}")
