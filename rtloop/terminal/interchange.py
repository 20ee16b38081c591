"""What the terminal shows of other programs' files: what is in them, how to map it, what was made of it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.markup import escape

from rtloop.interchange.mapping import name_without_unit
from rtloop.interchange.units import UnknownUnit, factor_between
from rtloop.terminal.table import console, table
from rtloop.values import count_text

MOST = 60
"""Columns of a file that are shown."""
LIKELY = (("x_drive_v", "V"), ("x_position_um", "µm"))


def print_import(report: Mapping[str, Any]) -> None:
    """What was written, and what is odd about it."""
    out = console()
    _print_about(out, report["about"])
    if report["mapping"]:
        out.print(f"mapping: {escape(report['mapping'])}")
    shown = table("signal", "unit", "least", "largest", "of")
    shown.columns[4].justify = "left"
    for one in report["signals"]:
        shown.add_row(
            one["name"], escape(one["unit"]), _number(one["least"]), _number(one["largest"]), escape(one["from"])
        )
    out.print(shown)
    _print_notes(out, report["notes"])
    length = f"{report['duration_s']:.6g} s at {report['rate_hz']:g} Hz, time: {escape(report['time'])}"
    out.print(f"{escape(report['output'])}: {count_text(report['ticks'], 'tick')}, {length}")


def print_listing(report: Mapping[str, Any]) -> None:
    """What is in a file, and how to import it."""
    out = console()
    rate = f", {report['rate_hz']:g} Hz by {escape(report['time'])}" if report["rate_hz"] else ""
    out.print(f"[bold]{escape(report['file'])}[/]: {count_text(report['rows'], 'row')}{rate}")
    _print_about(out, report["about"])
    shown = table("column", "unit", "least", "largest")
    for one in report["columns"][:MOST]:
        shown.add_row(escape(one["name"]), escape(one["unit"] or "?"), _number(one["least"]), _number(one["largest"]))
    out.print(shown)
    if len(report["columns"]) > MOST:
        out.print(f"… and {count_text(len(report['columns']) - MOST, 'column')} more; --json shows all of them")
    _print_notes(out, report["notes"])
    out.print("\nNothing was written. Which column is what, in which unit? Such as:\n")
    time = "" if report["rate_hz"] else " --rate HZ"
    out.print(f"  rtloop import {escape(shlex.quote(report['file']))}{time} \\")
    maps = [
        f"--map {escape(shlex.quote(f'{name}={source}'))}"
        for name, source in _likely(report["columns"], report["time_column"])
    ]
    out.print("    " + " \\\n    ".join(maps))
    out.print("\n--all takes every column as it is; rtloop import --help says more.")


def _likely(columns: list[dict[str, Any]], time: str | None) -> list[tuple[str, str]]:
    """A drive and a position by their units, else the first columns that are left and are no clock."""
    left, found = [one for one in columns if one["name"] != time and not _is_clock(one)], []
    for name, unit in LIKELY:
        one = next((one for one in left if _converts(one["unit"], unit)), next(iter(left), None))
        if one is not None:
            left.remove(one)
            fits = _converts(one["unit"], unit)
            found.append((name, f"{name_without_unit(one['name'])} [{one['unit'] if fits else unit}]"))
    return found


def _is_clock(column: dict[str, Any]) -> bool:
    """Whether a column has a unit of time, or no unit and grows evenly."""
    return _converts(column["unit"], "s") or (not column["unit"] and column["grows_evenly"])


def _converts(unit: str | None, target: str) -> bool:
    try:
        return bool(unit) and bool(factor_between(unit or "", target))
    except UnknownUnit:
        return False


def _print_about(out: Console, about: Mapping[str, str]) -> None:
    for name, what in about.items():
        out.print(f"{escape(name)}: {escape(what)}")


def _print_notes(out: Console, notes: list[str]) -> None:
    for note in notes:
        out.print(f"[yellow]note[/]: {escape(note)}")


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.6g}"
