"""The terminal's view of a change before it is applied. No numbers are made here."""

from __future__ import annotations

from typing import Any

from rich.markup import escape

from rtloop.terminal.table import console, table

ROWS = (
    ("crossover", "crossover_hz", "Hz"),
    ("phase margin", "phase_margin_deg", "°"),
    ("gain margin", "gain_margin_db", "dB"),
    ("modulus margin", "modulus_margin", ""),
    ("static error", "static_error_percent", "%"),
    ("settling (5 %)", "settling_ms", "ms"),
    ("overshoot", "overshoot_percent", "%"),
)


def print_preview(axis: str, answer: dict[str, Any]) -> None:
    """Print the figures of the running loop beside those of the change, then the problems of the change."""
    out, now, then = console(), answer["before"], answer["after"]
    shown = table(f"axis {axis}, on the model", "now", "after the change", "")
    for label, key, unit in ROWS:
        shown.add_row(label, _number(now[key]), _number(then[key]), unit)
    shown.add_row("resonance may move by", _shift(now), _shift(then), "%")
    out.print(shown)
    for problem in then["problems"]:
        out.print(f"[red]problem[/]: {escape(problem)}")


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"


def _shift(figures: dict[str, Any]) -> str:
    shift = figures["tolerated_shift_percent"]
    return "–" if shift is None else f"{shift[0]:+.1f} … {shift[1]:+.1f}"
