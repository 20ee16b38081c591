"""What the terminal shows of an identification. No numbers are made here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console

from rtloop.terminal.table import console, table


def print_hysteresis(report: dict[str, Any]) -> None:
    """Thresholds and weights, quality, h/H."""
    out = console()
    shown = table("operator", "threshold V", "weight µm/V")
    model = report["model"]
    for i, (r, p) in enumerate(zip(model["thresholds_v"], model["weights_um_per_v"], strict=True)):
        shown.add_row(str(i), f"{r:.4f}", f"{p:.4f}")
    out.print(shown)
    out.print(
        f"error of the fit {report['rms_error_um']:.3g} µm rms, at most {report['max_error_um']:.3g} µm "
        f"({report['max_error_percent']:.3g} % of {report['range_um']:.4g} µm); noise {report['noise_um']:.3g} µm"
    )
    _print_held_out(out, report)
    if report["unexplained_um"]:
        out.print(
            f"[yellow]the actuator is no sum of plays[/]: {report['unexplained_um']:.3g} µm rms are left however many "
            "there are; small steps and loops of other sizes may differ from the model's by more"
        )
    out.print(f"h/H {_number(report['measured_h_percent'])} % measured, {_number(report['model_h_percent'])} % model")
    if not report["invertible"]:
        out.print("[red]no inverse[/]: a partial sum of the weights is not above 0; --weights invertible keeps them so")
    _print_files(out, report)


def _print_held_out(out: Console, report: dict[str, Any]) -> None:
    """What the model errs by on each recording when that has no part in it, and what was taken along."""
    shown = table(
        "held out", "error µm rms", "at most µm", "% of range", "in % of it", "% before that", "as written µm rms",
        "offset µm", "drift µm", "memory at the start",
    )  # fmt: skip
    for row in report["held_out"]:
        memory = "from rest" if row["memory"] == "rest" else f"unknown; {_known(row['known_from_s'])}"
        errors = ("rms_error_um", "max_error_um", "max_error_percent", "judged_percent", "early_max_error_percent")
        shown.add_row(
            Path(row["recording"]).name + ("" if row["fitted"] else " (never fitted)"),
            *(_number(row[key], "{:.3g}") for key in errors),
            _number(row["as_written_rms_um"], "{:.3g}"), _number(row["offset_um"], "{:.4g}"), f"{row['drift_um']:.3g}",
            memory + ("; [yellow]unsettled[/]" if row["unsettled"] else ""),
        )  # fmt: skip
    out.print(shown)
    _print_all(out, report["held_out_all"])
    if "tried_um" in report:
        tried = ", ".join(f"{name} {error_um:.3g}" for name, error_um in report["tried_um"].items())
        out.print(f"held out, µm rms: {tried}; taken: {' + '.join(('plays', *report['terms']))}")
        out.print(
            f"for strokes of up to {report['stroke_v']:.4g} V" + (f"; {report['missing']}" if report["missing"] else "")
        )


def _print_all(out: Console, found: dict[str, Any]) -> None:
    """Of several recordings together."""
    error, written = found["error"], found["as_written"]
    if error["std_um"] is not None:
        out.print(f"together, held out: {_with_std(error)} µm rms; the plays as written {_with_std(written)}")


def _with_std(found: dict[str, Any]) -> str:
    std_um = found["std_um"]
    return f"{found['rms_um']:.3g}" + ("" if std_um is None else f" ± {std_um:.2g}")


def _known(from_s: float | None) -> str:
    return "never known wholly" if from_s is None else f"known from {from_s:.3g} s on"


def print_dynamics(report: dict[str, Any]) -> None:
    """Method, orders tried, modes with their uncertainty, what the residuals and a measured response say."""
    out = console()
    loop = report["loop"]
    ticks = f"; ticks {loop['from_tick']} to {loop['to_tick']}, moved by {', '.join(loop['outside'])}" if loop else ""
    out.print(f"{report['method']}, input: {report['input']}{ticks}", markup=False)
    shown = table("order", "error µm rms", "AIC", "validation µm rms")
    for one in report["candidates"]:
        name = f"{one['order']}" + (" ←" if one["order"] == report["order"] else "")
        shown.add_row(
            name, f"{one['rms_error_um']:.5f}", f"{one['aic']:.4f}", _number(one["validation_rms_um"], "{:.5f}")
        )
    out.print(shown)
    shown = table("mode", "Hz", "± (1σ)", "damping", "± (1σ)", "static share")
    for i, mode in enumerate(report["modes"]):
        shown.add_row(
            str(i), f"{mode['frequency_hz']:.3f}", _number(mode["frequency_std_hz"], "{:.2g}"),
            f"{mode['damping']:.5f}", _number(mode["damping_std"], "{:.2g}"), f"{mode['static_share']:.4f}",
        )  # fmt: skip
    out.print(shown)
    tests = report["tests"]
    out.print(
        f"static gain {report['static_gain']:.6g} ± {report['static_gain_std']:.2g} (1σ), which belongs to the "
        f"hysteresis (D(0) = 1); "
        f"delay {report['delay_ticks']} samples; fit {report['fit_percent']:.2f} %"
    )
    out.print(
        f"residuals: {'white' if tests['white'] else 'not white'} "
        f"(largest autocorrelation {tests['largest_autocorrelation']:.3f}), "
        f"{'independent of' if tests['independent'] else 'correlated with'} the input "
        f"({tests['largest_cross_correlation']:.3f}, {tests['cross_ratio']:.2g} of its 99 % bound)"
    )
    if not tests["white"]:
        out.print("± is that of noise with the correlation of these residuals; a wrong input is not in it")
    if report["level_correction"]:
        out.print(
            f"levels of the input corrected by up to {report['level_correction']:.3g}: the settled position measures "
            "what the model of the hysteresis misses there"
        )
    _print_response(out, report["frequency_response"])
    _print_files(out, report)


def print_compensation(report: dict[str, Any]) -> None:
    """ρ and ξ of eq (2), against simulation."""
    out = console()
    shown = table("ρ", "value", "ξ µm", "sine µm", "random µm", "worst case µm")
    for row in report["bounds"]:
        simulated = row["simulated_um"]
        values = (row["rho"], row["xi_um"], simulated["sine"], simulated["random"], simulated["worst_case"])
        shown.add_row(row["gain"].replace("_", " "), *(f"{value:.4f}" for value in values))
    out.print(f"|v| ≤ {report['command_um']:g} µm: largest |Ω| = |y − ρ v|, bound ξ and simulated")
    out.print(shown)
    out.print(
        f"as eq (3) is printed: {report['eq_3_um']:.4f} µm (no bound where the weights have both signs); "
        f"Σ ζ|w|: {report['triangle_bound_um']:.4f} µm"
    )
    if report["dead_band"] == "exact":
        out.print("dead_band = 'exact' is not part of this: it leaves less")
    _print_files(out, report)


def _print_response(out: Console, found: dict[str, Any] | None) -> None:
    if found:
        out.print(
            f"measured response, {found['from_hz']:.4g} to {found['to_hz']:.4g} Hz: median deviation "
            f"{100 * found['median_deviation']:.2f} %, largest {100 * found['largest_deviation']:.1f} % at "
            f"{found['largest_at_hz']:.4g} Hz; peak at {found['measured_peak_hz']:.4g} Hz, model "
            f"{found['model_peak_hz']:.4g} Hz"
        )


def _print_files(out: Console, report: dict[str, Any]) -> None:
    for key in ("output", "plot"):
        if report.get(key):
            out.print(report[key], markup=False)


def _number(value: float | None, form: str = "{:.2f}") -> str:
    return "–" if value is None else form.format(value)
