"""Result of a check as text: the plan, then limits, law, analyses and verdict of each axis."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rtloop.configuration.simulated import drive_ends_um
from rtloop.supervision.recording_path import recordings_folder
from rtloop.values import count_text
from rtloop.workbench.tables import escape, format_figure, table

if TYPE_CHECKING:
    from rich.console import Console

    from rtloop.configuration.axis import AxisOptions, InterlockOptions
    from rtloop.configuration.checks import AxisCheck
    from rtloop.configuration.prepare import Prepared
    from rtloop.drivers.base import Channel
    from rtloop.workbench.axis_judgement import AxisJudgement

ROWS = (
    ("stable", lambda loop: "yes" if loop.stable else "NO"),
    ("crossover", lambda loop: f"{loop.crossover_hz:.2f} Hz"),
    ("phase margin", lambda loop: f"{loop.phase_margin_deg:.2f}°"),
    ("gain margin", lambda loop: f"{loop.gain_margin:.3f}"),
    ("max |S|", lambda loop: f"{loop.max_sensitivity:.3f} at {loop.max_sensitivity_hz:.1f} Hz"),
    ("static error", lambda loop: format_figure(loop.static_error_percent, 4, " %")),
    ("settling (5 %)", lambda loop: format_figure(1e3 * loop.settling_time_s, 2, " ms")),
    ("overshoot", lambda loop: format_figure(loop.overshoot_percent, 2, " %")),
    ("peak command, µm per µm", lambda loop: format_figure(loop.peak_command, 4)),
)


def print_plan(out: Console, prepared: Prepared) -> None:
    """Print the configuration's name, axes, rate, mode and driver, and the folder for its recordings."""
    plan, facts = prepared.plan, prepared.facts
    axes = count_text(len(plan.axes), "axis", "axes")
    driver = f"driver {plan.driver_kind} ({len(facts.inputs)} inputs, {len(facts.outputs)} outputs)"
    rate = f"{plan.pacing.rate_hz:g} Hz"
    out.print(f"[bold]{escape(plan.name)}[/]: {axes} at {rate}, mode {plan.mode.name.lower()}, {driver}")
    out.print(f"records into {escape(str(recordings_folder(prepared.configuration)))}", soft_wrap=True)


def print_axis(out: Console, judgement: AxisJudgement, sensor: Channel) -> None:
    """Print limits, law, analyses, this host's delay and verdict of one axis.

    `sensor` is the driver's input channel to which the axis's position sensor is wired.
    """
    from rtloop.design.verification.text import answer

    axis = judgement.axis
    limits = axis.limits
    drive = (
        f"±{limits.drive_v:g}" if limits.lowest_v == -limits.drive_v else f"{limits.lowest_v:g} … {limits.drive_v:g}"
    )
    slew = "no slew limit while running" if limits.slew_v_per_s is None else f"slew {limits.slew_v_per_s:g} V/s"
    out.print(
        f"\n[bold]axis {axis.name}[/]: drive {drive} V, command {_command_text(axis)} µm, {slew}, "
        f"trip ramp {limits.trip_slew_v_per_s:g} V/s; the loop trips beyond ±{axis.interlocks.position_um:g} µm"
        f"{_sensor_text(axis.interlocks, sensor)}"
    )
    _print_law(out, judgement.check)
    _print_analyses(out, judgement)
    if judgement.spent is not None:
        out.print(judgement.spent.text)
    if judgement.verification is not None:
        sentence = answer(judgement.verification)
        out.print(f"{escape(axis.specification)}: {sentence}; `rtloop design verify` simulates steps as well")


def _command_text(axis: AxisOptions) -> str:
    """Return the command's range in µm as text: "±40"; for a drive of one sign "0 … 40" or "-40 … 0"."""
    command_um = axis.limits.command_um
    down_um, up_um = drive_ends_um(axis)
    if down_um < 0 < up_um or down_um == up_um:
        return f"±{command_um:g}"
    return f"0 … {command_um:g}" if up_um > 0 else f"-{command_um:g} … 0"


def _sensor_text(interlocks: InterlockOptions, sensor: Channel) -> str:
    """Return the voltages at which the sensor interlock trips, as the end of a sentence on the position interlock.

    A limit outside the input's range never trips: it is left out, and the text states the input's range.
    """
    low_v, high_v = interlocks.sensor_min_v, interlocks.sensor_max_v
    has_low, has_high = low_v > sensor.minimum_v, high_v < sensor.maximum_v
    if has_low and has_high:
        return f" or outside {low_v:g} … {high_v:g} V at the sensor"
    ends = f"whose input reads {sensor.minimum_v:g} … {sensor.maximum_v:g} V"
    if not has_low and not has_high:
        return f", but at no voltage of the sensor, {ends}"
    return f" or {f'below {low_v:g}' if has_low else f'above {high_v:g}'} V at the sensor, {ends}"


def _print_law(out: Console, check: AxisCheck) -> None:
    """Print kind and order of an axis's controller, and the frequencies in C(s) and C(z) of each notch and resonance.

    A further axis of a shared controller gets one line with the axis whose controller it shares.
    """
    linear = check.linear if check.together is None else check.together.linear
    order = "" if linear is None else f", linear near its rest state, of order {linear.order}"
    if check.law is None:
        out.print("no controller; allowed modes: feedforward, raw and off")
    elif check.together is not None:
        axes = check.together.axes
        shares = f"shares the controller of axis {axes[0]}"
        out.print(
            shares if check.together.place else f"law {check.together.law.kind!r} of axes {', '.join(axes)}{order}"
        )
    elif check.discrete is not None and check.comparison is not None:
        out.print(f"C(z) by the method {check.discrete.method!r}, of order {check.discrete.order}")
        for shift in check.comparison.shifts:
            out.print(f"  {shift.kind} of C(s) at {shift.frequency_hz:.1f} Hz: at {shift.discrete_hz:.1f} Hz in C(z)")
    else:
        out.print(f"law {check.law.kind!r}{order}")


def _print_analyses(out: Console, judgement: AxisJudgement) -> None:
    """Print the figures of an axis's loop, with C(s) and as it runs.

    For the first axis of a shared controller, the margins of all its axes together follow.
    """
    from rtloop.design.verification.text import format_range, simultaneous_rows

    check, shifts = judgement.check, judgement.shifts
    analyses = {"continuous C(s)": ("continuous", check.continuous), "as it runs": ("running", check.running)}
    analyses = {heading: (key, analysis) for heading, (key, analysis) in analyses.items() if analysis is not None}
    if check.law is None or not analyses:
        return
    heading = "on the model" if check.together is None else "on the models, one loop opened at a time"
    rows = [(label, *(format_value(analysis) for _, analysis in analyses.values())) for label, format_value in ROWS]
    if judgement.is_stable_on_rig is not None:
        stable = "yes" if judgement.is_stable_on_rig else "[red]NO[/]"
        rows.insert(1, ("stable on the simulated rig", *("" for _ in list(analyses)[1:]), stable))
    if shifts:
        rows.append(("resonance may move by", *(format_range(shifts[key]) for key, _ in analyses.values())))
    out.print(table(heading, *analyses, rows=rows, words=(1, 2)))
    if check.together is not None and check.together.margins is not None and check.together.place == 0:
        heading = f"{' and '.join(check.together.axes)} together"
        out.print(table(heading, "as they run", rows=simultaneous_rows(check.together.margins), words=(1,)))
