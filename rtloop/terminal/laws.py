"""What there is in laws, as a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.markup import escape

from rtloop.terminal.table import console, table


def print_laws(laws: Sequence[dict[str, Any]]) -> None:
    """Every registered kind."""
    shown = table("kind", "slot", "what it is", "comes with")
    for column in shown.columns[1:]:
        column.justify = "left"
    for law in laws:
        about = f"[red]{escape(law['problem'])}[/]" if law["problem"] else escape(law["about"] or "")
        origin = "rtloop" if law["shipped"] else escape(law["defined_in"])
        shown.add_row(law["kind"], law["slot"] or "", about, origin)
    console().print(shown)
    console().print(
        escape('\nmore: file = "mine.py" in [axis.controller]; rtloop law new mine writes one to begin with')
    )
