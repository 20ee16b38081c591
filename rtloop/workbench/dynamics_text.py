"""Identified dynamics as text: orders that were tried, modes, tests of the residuals, a measured response."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rtloop.design.identification.dynamics.residuals import LARGEST_CROSS_RATIO
from rtloop.design.identification.frequency_response import SEGMENT_S
from rtloop.design.identification.model_sections import left_out_text, static_gain_text
from rtloop.values import count_text
from rtloop.workbench.hysteresis_text import print_files
from rtloop.workbench.tables import format_number, table

if TYPE_CHECKING:
    from rich.console import Console


def print_dynamics(out: Console, report: Mapping[str, Any]) -> None:
    """Print orders that were tried, modes with their uncertainty, tests of the residuals, and a measured response.

    `report` is the object of `DynamicsResult.as_dict`.
    """
    loop = report["loop"]
    ticks = ""
    if loop:  # `to_tick` is the tick after the last
        ticks = f"; ticks {loop['from_tick']} to {loop['to_tick'] - 1}, moved by {', '.join(loop['outside'])}"
    out.print(f"{report['method']}, input: {report['input']}{ticks}", markup=False)
    rows = table("order", "error µm rms", "AIC", "validation µm rms")
    for candidate in report["candidates"]:
        name = f"{candidate['order']}" + (" ←" if candidate["order"] == report["order"] else "")
        figures = (f"{candidate['rms_error_um']:.5f}", f"{candidate['aic']:.4f}")
        rows.add_row(name, *figures, format_number(candidate["validation_rms_um"], ".5f"))
    out.print(rows)
    rows = table("mode", "Hz", "± (1σ)", "damping", "± (1σ)", "static share")
    for i, mode in enumerate(report["modes"]):
        rows.add_row(
            str(i), f"{mode['frequency_hz']:.3f}", format_number(mode["frequency_std_hz"], ".2g"),
            f"{mode['damping']:.5f}", format_number(mode["damping_std"], ".2g"), f"{mode['static_share']:.4f}",
        )  # fmt: skip
    out.print(rows)
    tests = report["tests"]
    spread = f" ± {report['static_gain_std']:.2g} (1σ)"
    out.print(f"D(0) = 1; {static_gain_text(report['static_gain'], report['input'], spread)}", markup=False)
    out.print(f"delay {count_text(report['delay_ticks'], 'sample')}; fit {report['fit_percent']:.2f} %")
    out.print(
        f"prediction error, one step ahead: {report['rms_error_um']:.5f} µm rms over the whole recording. In the table "
        'of orders, "error" is the error in the part of the recording that was held out of the fit, or in the whole '
        'recording if no part was; "validation" is the error on the other recordings, – without any'
    )
    if report["visible_hz"] < report["nyquist_hz"]:
        out.print(
            f"the recording shows the dynamics up to {report['visible_hz']:.0f} Hz: beyond it, the driven motion is "
            "below the errors of the model, and a resonance would stay unseen"
        )
    if report["begins_in_motion"]:
        out.print(
            "the input before the recording is unknown: the motion that it left was estimated and left out of the fit"
        )
    if report["free_motion_s"]:
        out.print(
            f"the recording does not begin at rest: its first {1e3 * report['free_motion_s']:.3g} ms contain free "
            "motion, which no recorded input explains. This motion was estimated and left out of the fit"
        )
    if report["sampled_together"]:
        out.print(
            "the delay assumes that drive and position of a row were sampled at the same time. If the position was "
            "sampled before the drive changed, the delay is one sample less; then use rtloop import --position-first"
        )
    out.print(
        f"residuals: {'white' if tests['white'] else 'not white'} "
        f"(largest autocorrelation {tests['largest_autocorrelation']:.3f}), "
        f"{'independent of' if tests['independent'] else 'correlated with'} the input "
        f"(largest cross-correlation {tests['largest_cross_correlation']:.3f}, {tests['cross_ratio']:.2g} of its 99 % "
        "bound)"
    )
    if tests["cross_ratio"] > LARGEST_CROSS_RATIO:
        out.print(
            f"no order explains the recording: the standard deviations (±) are widened {tests['cross_ratio']:.2g} "
            "times. Compare with a measured response (--compare), or record a longer rest between the steps"
        )
    elif not tests["white"]:
        out.print("the standard deviations (±) include the correlation of these residuals, but no error of the input")
    if report["level_correction"]:
        unit = "V" if report["input"] == "drive" else "µm"
        out.print(
            f"the levels of the input were corrected by up to {report['level_correction']:.3g} {unit}, so that they "
            "agree with the position. The model of the hysteresis has this error at these levels."
        )
    if report["left_out_hz"]:
        out.print(left_out_text(report["left_out_hz"]))
    _print_response(out, report["frequency_response"])
    print_files(out, report)


def _print_response(out: Console, comparison: Mapping[str, float] | None) -> None:
    """Print the deviation of the model from a measured frequency response; for None, print no line."""
    if comparison:
        out.print(
            f"measured response, {comparison['from_hz']:.4g} to {comparison['to_hz']:.4g} Hz, resolution "
            f"{comparison['resolution_hz']:.3g} Hz{_resolution_note(comparison['resolution_hz'])}: the model deviates "
            f"by {100 * comparison['median_deviation']:.2f} % (median), {100 * comparison['largest_deviation']:.1f} % "
            f"(largest, at {comparison['largest_at_hz']:.4g} Hz); the measured peak is at "
            f"{comparison['measured_peak_hz']:.4g} Hz, the model's at {comparison['model_peak_hz']:.4g} Hz"
        )


def _resolution_note(resolution_hz: float) -> str:
    """Return a note on a resolution that is coarser than usual, because the recording is short; else ""."""
    usual_hz = 1 / SEGMENT_S
    least_s = 2 * SEGMENT_S
    return (
        ""
        if resolution_hz <= 1.01 * usual_hz
        else f" (a resolution of {usual_hz:g} Hz needs {least_s:g} s of excitation)"
    )
