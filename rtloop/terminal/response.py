"""What the terminal shows of a closed loop that was measured. No numbers are made here."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rtloop.terminal.table import console, table

MARGINS = (
    ("crossover_hz", "crossover", "Hz"),
    ("gain_margin", "gain margin", ""),
    ("gain_margin_hz", "  at", "Hz"),
    ("phase_margin_deg", "phase margin", "°"),
    ("modulus_margin", "modulus margin", ""),
    ("max_sensitivity", "largest |S|", ""),
    ("max_sensitivity_hz", "  at", "Hz"),
)


def print_response(content: dict[str, Any], files: Sequence[Path]) -> None:
    """Margins with their uncertainty beside the model's, the light mode, what was excited."""
    out, model = console(), content["model"]
    shown = table("margin", "measured", "± (1σ)", "model", "")
    for name, label, unit in MARGINS:
        found = content["margins"][name]
        promised = model and model["margins"].get(name)
        shown.add_row(label, _number(found["value"]), _number(found["std"], 2), _number(promised), unit)
    out.print(shown)
    if model:
        out.print(f"|L| measured over the model's, in the median: {_number(model['gain_ratio'])}")
    if content["resonance"]:
        print_resonance(content)
    out.print(
        f"{content['lines']} lines, {content['from_hz']:g} … {content['to_hz']:g} Hz, {content['periods']} periods; "
        f"the position moved by {content['moved_um']:.3g} µm"
    )
    for file in files:
        out.print(file, markup=False)


def print_resonance(content: dict[str, Any]) -> None:
    """Frequency and damping with their uncertainty."""
    mode = content["resonance"]
    console().print(
        f"resonance {mode['hz']:.3f} ± {mode['hz_std']:.2g} Hz, damping {mode['damping']:.5f} ± "
        f"{mode['damping_std']:.2g} (1σ; {mode['from_hz']:g} … {mode['to_hz']:g} Hz; the residuals are "
        f"{mode['misfit']:.2g} times as large as the measurement's uncertainty explains)"
    )


def _number(value: float | None, digits: int = 4) -> str:
    return "–" if value is None else f"{value:.{digits}g}"
