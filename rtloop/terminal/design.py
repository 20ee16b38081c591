"""What the terminal shows of a design. No numbers are made here."""

from __future__ import annotations

from collections.abc import Sequence

import click
from rich.markup import escape
from rich.table import Table

from rtloop.design.synthesis.synthesise import Synthesis
from rtloop.design.verification.text import (
    NOTE,
    answer,
    robustness,
    scenarios,
    shifts,
    simulated,
    simulation_notes,
    table,
    together,
)
from rtloop.design.verification.verify import Verification
from rtloop.terminal.table import console
from rtloop.terminal.table import table as lines

RED = {"MISSED", "NO"}


def print_synthesis(found: Synthesis, slicot: float | None) -> None:
    """γ, orders and norms, on stderr: stdout is for the section itself."""
    hinf = found.hinf
    click.echo(f"γ_opt {hinf.gamma_opt:.6g}; just below it fails: {hinf.limiting}", err=True)
    if slicot is not None:
        click.echo(f"SLICOT's SB10AD: {slicot:.6g}, {100 * (slicot / hinf.gamma_opt - 1):+.5f} %", err=True)
    click.echo(
        f"order {found.full.order} at γ = {hinf.gamma:.6g} achieves {hinf.achieved:.6g}; "
        f"order {found.controller.order} achieves {found.achieved:.6g}",
        err=True,
    )


def print_verification(name: str, found: Verification) -> None:
    """Every table of one axis, and the answer."""
    out = console()
    out.print(f"[bold]axis {name}[/]")
    headings, *rows = table(found)
    out.print(_table(headings, rows))
    for lines_ in (scenarios(found), simulated(found)):
        if lines_:
            out.print()
            out.print(_table(lines_[0], lines_[1:]))
    for note in simulation_notes(found):
        out.print(escape(note))
    if found.together is not None:
        out.print("\nAll axes of its controller together, as they run")
        out.print(_table(("", ""), together(found.together)))
    if found.robustness.shifts:
        out.print("\nThe resonance may move by")
        out.print(_table(("", ""), shifts(found)))
    out.print()
    headings, *rows = robustness(found)
    out.print(_table(headings, rows))
    out.print(NOTE)
    if found.host is not None:
        out.print(found.host.text)
    out.print(f"\n[bold]{escape(answer(found))}[/]")
    for warning in found.warnings:
        click.echo(f"warning: {warning}", err=True)


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    shown = lines(*headings)
    for column in shown.columns:
        column.justify = "left"
    for row in rows:
        shown.add_row(*(f"[red]{cell}[/]" if cell in RED else cell for cell in row))
    return shown
