"""Identified hysteresis as text: plays, errors, the relative height of the loop."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtloop.workbench.tables import format_number, table

if TYPE_CHECKING:
    from rich.console import Console


def print_hysteresis(out: Console, report: Mapping[str, Any]) -> None:
    """Print thresholds, weights, errors, and the measured and the model's relative loop height h/H.

    `report` is the object of `HysteresisResult.as_dict`.
    """
    model = report["model"]
    plays = enumerate(zip(model["thresholds_v"], model["weights_um_per_v"], strict=True))
    rows = [(str(i), f"{threshold:.4f}", f"{weight:.4f}") for i, (threshold, weight) in plays]
    out.print(table("operator", "threshold V", "weight µm/V", rows=rows))
    out.print(
        f"error of the fit: {report['rms_error_um']:.3g} µm rms, at most {report['max_error_um']:.3g} µm "
        f"({report['max_error_percent']:.3g} % of the range of {report['range_um']:.4g} µm); noise of the position "
        f"{report['noise_um']:.3g} µm rms"
    )
    _print_held_out(out, report)
    if report["unexplained"]:
        cause, colon, error = report["unexplained"].partition(":")
        out.print(f"[yellow]{cause}[/]{colon}{error}")
    out.print(
        "height of the hysteresis loop in percent of the position's range: "
        f"{format_number(report['measured_h_percent'], '.2f')} % measured, "
        f"{format_number(report['model_h_percent'], '.2f')} % by the model"
    )
    if not report["invertible"]:
        out.print(
            "[red]the model has no inverse[/]: a partial sum of the weights is not above 0. Use --weights invertible"
        )
    print_files(out, report)


def _print_held_out(out: Console, report: Mapping[str, Any]) -> None:
    """Print the model's error on each held-out recording and, if two or more can be judged, over all fitted ones.

    After a fit of recordings whose state of the hysteresis at the start is unknown (`tried_um` in the report), it also
    prints the error with each set of effects beside the plays, such as creep, the chosen set, and the strokes for which
    the model is valid.
    """
    rows = table(
        "held out", "error µm rms", "at most µm", "at most %", "judged %", "at most % before", "plays alone µm rms",
        "offset µm", "drift µm", "memory at the start",
    )  # fmt: skip
    for row in report["held_out"]:
        memory, from_s = "from rest", row["known_from_s"]
        if row["memory"] != "rest":
            extent = "never fully known" if from_s is None else f"known from {from_s:.3g} s on"
            memory = f"unknown; {extent}"
        errors = ("rms_error_um", "max_error_um", "max_error_percent", "judged_percent", "early_max_error_percent")
        rows.add_row(
            Path(row["recording"]).name + ("" if row["fitted"] else " (validation only)"),
            *(format_number(row[key], ".3g") for key in errors),
            format_number(row["as_written_rms_um"], ".3g"), format_number(row["offset_um"], ".4g"),
            f"{row['drift_um']:.3g}",
            memory + ("; [yellow]unsettled[/]" if row["unsettled"] else ""),
        )  # fmt: skip
    out.print(rows)
    combined = report["held_out_all"]
    error, written = combined["error"], combined["as_written"]
    if error["std_um"] is not None:
        out.print(
            f"held-out error over all fitted recordings: {_rms_text(error)} µm rms; with the plays alone: "
            f"{_rms_text(written)} µm rms"
        )
    if "tried_um" in report:
        trials_text = ", ".join(f"{name} {error_um:.3g}" for name, error_um in report["tried_um"].items())
        out.print(
            f"held-out error of each model in µm rms: {trials_text}; chosen model: "
            f"{' + '.join(('plays', *report['terms']))}"
        )
        missing = f"; {report['missing']}" if report["missing"] else ""
        out.print(f"this model is valid for strokes of up to {report['stroke_v']:.4g} V{missing}")


def _rms_text(error: Mapping[str, float | None]) -> str:
    """Return `rms_um`, and `std_um` unless it is None, as text without a unit: `0.12 ± 0.03 (1σ)`."""
    std_um = error["std_um"]
    return f"{error['rms_um']:.3g}" + ("" if std_um is None else f" ± {std_um:.2g} (1σ)")


def print_files(out: Console, report: Mapping[str, object]) -> None:
    """Print the paths of the files that a report names as written, `output` and `plot`; no line for None or no key."""
    for key in ("output", "plot"):
        if report.get(key):
            out.print(report[key], markup=False)
